// ---- Words and numbers ----

const THIN = "\u202f";
const MINUS = "\u2212";

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);
const number = (value, digits = 0) => value.toFixed(digits).replace(/^-(?=.*[1-9])/, MINUS).replace(/^-/, "");
const amount = (value, digits, unit) => (known(value) ? `${number(value, digits)}${THIN}${unit}` : "\u2013");
/** Return the largest value; Math.max would get more arguments than a call may have. */
function largest(values, least = 0) {
  let most = least;
  for (const value of values) if (value > most) most = value;
  return most;
}

const short = (value) => String(Number(value.toPrecision(3))).replace("-", MINUS);

/** Return the next larger number that is easy to read on a scale. */
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((factor) => factor * power >= value * (1 - 1e-9));
}

function duration(seconds) {
  if (!known(seconds)) return "unknown";
  if (seconds < 100) return `${Math.floor(seconds)}${THIN}s`;
  return seconds < 6000 ? `${Math.floor(seconds / 60)}${THIN}min` : `${Math.floor(seconds / 3600)}${THIN}h`;
}

const ago = (seconds) => (seconds < 1 ? "a moment ago" : `${duration(seconds)} ago`);

function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

const byId = (id) => document.getElementById(id);
const nowS = () => performance.now() / 1000;
const style = getComputedStyle(document.documentElement);
const colour = (name) => style.getPropertyValue(`--${name}`).trim();

// ---- Numbers of a sensor ----

const TOO_LIGHT = "too light to check";
const ORIGINS = { "start-up": "start-up", file: "file", demand: "on demand", recording: "this recording", unsure: "this recording, maybe held" };
const list = (values, decimals, unit) => (values ? `${values.map((value) => number(value, decimals)).join(", ")}${THIN}${unit}` : "\u2013");

/** Return where to touch next, in words for the pad as it is drawn. */
function nextTapText(next) {
  if (!next) return "\u2013";
  const ways = [[next.dx_mm, "left", "right"], [next.dy_mm, "up", "down"]].filter(([mm]) => mm !== 0);
  return ways.map(([mm, less, more]) => `${amount(Math.abs(mm), 1, "mm")} ${mm < 0 ? less : more}`).join(", ");
}

function trustText({ state, trusted, untrusted_reason: reason }) {
  if (trusted === true || trusted === false) return trusted ? "yes" : `no: ${reason}`;
  return state !== "contact" ? "\u2013" : page.hello.checks ? TOO_LIGHT : "not checked";
}

/**
 * Numbers by group: label, key, what it means, and its text, made of the newest result, of that of the pattern shown
 * (`made`), and of the sensor. Those without a text are losses, which are counted.
 */
const NUMBERS = {
  Contact: [
    ["force", "force", "Force into the pad: z of all taxels over the baseline. Nominal is by the average sensor's counts per newton, until the doctor has weighed this one.",
      ({ sensor }) => sensor.part["force-now"].textContent],
    ["area", "area", "Area of the touched pixels: those near enough to the pattern's largest value, by the model's own share.",
      ({ sensor }) => sensor.part["area-now"].textContent],
    ["centre", "centroid_mm", "Centre of the touched area, weighted by depth: x to the right, y down, from the pad's centre.",
      ({ made }) => list(made.centroid_mm, 1, "mm")],
    ["taps used", "taps_used", "Taps that the pattern was made of, and the most that the model takes.",
      ({ made }) => (made.taps_used ? `${made.taps_used} of ${page.hello.taps}` : "\u2013")],
    ["another tap", "another_tap", "Whether one more tap is expected to make the error smaller.",
      ({ made }) => ({ true: "would help", false: "would not help" })[made.another_tap] ?? "\u2013"],
    ["next tap", "next_tap", "Where to touch next: half a pitch from the taps so far.", ({ result }) => nextTapText(result.next_tap)],
  ],
  Wrench: [
    ["force x y z", "wrench_force", "Force on the pad along x, y and z, as the model integrates it.", ({ made }) => list(made.wrench?.force_n, 2, "N")],
    ["torque x y", "wrench_torque", "Torque about x and y at the pad's centre.", ({ made }) => list(made.wrench?.torque_n_mm.slice(0, 2), 1, "N\u00a0mm")],
    ["twist", "wrench_twist", "Torque about the pad's normal.", ({ made }) => amount(made.wrench?.torque_n_mm[2], 1, "N\u00a0mm")],
    ["pressure centre", "centre_of_pressure_mm", "Point where the normal force acts; the ring on the pattern.",
      ({ made }) => list(made.wrench?.centre_of_pressure_mm, 1, "mm")],
    ["sensitivity", "wrench_origin", "Where the force scale comes from, nominal is that of the average sensor, and how far off all newtons may be.",
      ({ made, result }) => `${made.wrench_origin ?? "\u2013"} ${known(result.scale_error) ? `\u00b1 ${number(100 * result.scale_error)}${THIN}%` : ""}`],
  ],
  Uncertainty: [
    ["to be believed", "trusted", "Whether the readings fit the pattern; one that is not checked, or a pattern that is not to be believed must not be acted on.",
      ({ made }) => trustText(made)],
    ["mismatch", "mismatch", "Share of the readings that the pattern does not explain.",
      ({ made }) => amount(known(made.mismatch) ? 100 * made.mismatch : null, 1, "%")],
    ["90 % within", "interval_mm", "Nine of ten pixels are expected within this distance of the truth.",
      ({ made }) => (known(made.interval_mm) ? `\u00b1 ${amount(made.interval_mm, 3, "mm")}` : "\u2013")],
  ],
  Timing: [
    ["rate", "rate_hz", "Scans a second from the sensor.", ({ result }) => amount(result.rate_hz, 1, "Hz")],
    ["run time", "run_time_us", "Time of one inference.", ({ made }) => amount(made.run_time_us, 0, "\u00b5s")],
    ["latency", "latency_us", "Time from the scan's last byte to its pattern; of a recording there is none.",
      ({ made }) => amount(known(made.latency_us) ? made.latency_us / 1000 : null, 2, "ms")],
  ],
  Losses: [
    ["dropped", "dropped", "Scans without a pattern, since a newer one was waiting. Their force is followed all the same."],
    ["missed", "missed", "Scans that never came, by the sensor's own period."],
    ["late", "late", "Patterns that were ready later than one scan period after their scan."],
    ["torn on the wire", "torn_wire", "Scans of which a part did not arrive."],
    ["unwritten", "unwritten", "Records that a slow disk or reader did not take."],
  ],
  Baseline: [
    ["id", "baseline", "Short name of the zero that is subtracted.", ({ result }) => result.baseline ?? "none"],
    ["origin", "baseline_origin", "Whether it was taken at the start, on demand, from this recording, or comes from a file.",
      ({ result }) => ORIGINS[result.baseline_origin] ?? result.baseline_origin ?? "\u2013"],
    ["age", "baseline_age_s", "Time since it was taken; unknown if the clock, or a recording, does not state it.",
      ({ result }) => (result.baseline === null ? "\u2013" : duration(result.baseline_age_s))],
    ["drift x y z", "drift", "Drift of the free pad since it was zeroed, mean of all taxels.",
      ({ result }) => result.drift_counts?.common.map((counts) => number(counts, 1)).join(" ") ?? "\u2013"],
  ],
};
