// ---- Numbers of a sensor ----

const NUMBERS = {
  Contact: [
    ["force", "force", "big"], ["area", "area", "big"], ["centre", "centroid_mm"], ["size", "ellipse"], ["long axis", "axis"], ["taps used", "taps_used"], ["another tap", "another_tap"],
    ["next tap", "next_tap"],
  ],
  Wrench: [
    ["force x y z", "wrench_force"], ["torque x y", "wrench_torque"], ["twist", "wrench_twist"], ["pressure centre", "centre_of_pressure_mm"],
    ["sensitivity", "wrench_origin"],
  ],
  Uncertainty: [
    ["to be believed", "trusted"], ["mismatch", "mismatch"], ["tap mismatch", "tap_mismatch"], ["90 % within", "interval_mm"],
    ["expected RMSE", "expected_rmse_mm"], ["gains", "gains_certainty"],
  ],
  Timing: [["rate", "rate_hz"], ["run time", "run_time_us"], ["latency", "latency_us"], ["pattern", "reused_from"], ["model", "model"]],
  Losses: [["dropped", "dropped"], ["missed", "missed"], ["late", "late"], ["torn on the wire", "torn_wire"], ["unwritten", "unwritten"]],
  Baseline: [["id", "baseline"], ["origin", "baseline_origin"], ["age", "baseline_age_s"], ["drift x y z", "drift"], ["taxel, step", "own"]],
};
const LOSS_SHARE = 0.01; // of the scans: fewer losses, as in the first second of a run, are no reason to worry
const LOSSES = new Set(["dropped", "missed", "late", "torn_wire", "unwritten"]);
const ORIGINS = { "start-up": "start-up", file: "file", demand: "on demand", recording: "this recording", unsure: "this recording, maybe held" };
const TOO_LIGHT = "too light to check";

/** Return the texts of the numbers by which a pattern is believed or not; `checks`: whether the model has any. */
function trustTexts({ state, trusted, untrusted_reason: reason, mismatch, tap_mismatch: taps }, checks) {
  const unknown = state !== "contact" ? "\u2013" : checks ? TOO_LIGHT : "not checked";
  return {
    trusted: trusted === true ? "yes" : trusted === false ? `no: ${reason}` : unknown,
    mismatch: percent(mismatch),
    tap_mismatch: taps?.length ? taps.map((share) => number(share, 2)).join(", ") : "\u2013",
  };
}

/** Return where to touch next, in words for the pad as it is drawn. */
function nextTapText(next) {
  if (!next) return "\u2013";
  const ways = [[next.dx_mm, "left", "right"], [next.dy_mm, "up", "down"]].filter(([mm]) => mm !== 0);
  const moves = ways.map(([mm, less, more]) => `${amount(Math.abs(mm), 1, "mm")} ${mm < 0 ? less : more}`);
  return moves.join(", ");
}

function wrenchTexts({ wrench, wrench_origin: origin }) {
  const list = (values, decimals, unit) => (values ? `${values.map((value) => number(value, decimals)).join(", ")}${THIN}${unit}` : "\u2013");
  return {
    wrench_force: list(wrench?.force_n, 2, "N"),
    wrench_torque: list(wrench?.torque_n_mm.slice(0, 2), 1, "N\u00a0mm"),
    wrench_twist: amount(wrench?.torque_n_mm[2], 1, "N\u00a0mm"),
    centre_of_pressure_mm: list(wrench?.centre_of_pressure_mm, 1, "mm"),
    wrench_origin: origin ?? "\u2013",
  };
}

/** Return the texts of a sensor's numbers, without losses, by key. */
function numberTexts(sensor) {
  const { result, hello } = sensor;
  const made = sensor.made();
  const drift = result.drift_counts;
  const ellipse = made.state === "contact" && made.trusted !== false && sensor.newest() ? sensor.ellipse() : null;
  return {
    force: sensor.part["force-now"].textContent,
    area: sensor.part["area-now"].textContent,
    centroid_mm: made.centroid_mm ? `${made.centroid_mm.map((mm) => number(mm, 1)).join(", ")}${THIN}mm` : "\u2013",
    ellipse: ellipseText(ellipse),
    axis: axisText(ellipse),
    ...wrenchTexts(made),
    ...trustTexts(made, hello.checks),
    taps_used: made.taps_used ? `${made.taps_used} of ${hello.taps}` : "\u2013",
    another_tap: made.another_tap === true ? "would help" : made.another_tap === false ? "would not help" : "\u2013",
    next_tap: nextTapText(result.next_tap),
    interval_mm: known(made.interval_mm) ? `\u00b1 ${amount(made.interval_mm, 3, "mm")}` : "\u2013",
    expected_rmse_mm: amount(made.expected_rmse_mm, 4, "mm"),
    gains_certainty: known(result.gains_certainty) ? `${number(100 * result.gains_certainty, 0)}${THIN}% certain` : "not known",
    reused_from: sensor.live() ? (known(made.reused_from) ? "unchanged" : "new") : "\u2013",
    rate_hz: amount(result.rate_hz, 1, "Hz"),
    run_time_us: amount(made.run_time_us, 0, "\u00b5s"),
    latency_us: amount(known(made.latency_us) ? made.latency_us / 1000 : null, 2, "ms"),
    model: result.model ?? "\u2013",
    baseline: result.baseline ?? "none",
    baseline_origin: ORIGINS[result.baseline_origin] ?? result.baseline_origin ?? "\u2013",
    baseline_age_s: result.baseline === null ? "\u2013" : duration(result.baseline_age_s),
    drift: drift ? `${drift.common.map((counts) => number(counts, 1)).join(" ")}` : "\u2013",
    own: drift ? `${number(drift.own, 1)}, ${number(drift.step, 0)} counts` : "\u2013",
  };
}
