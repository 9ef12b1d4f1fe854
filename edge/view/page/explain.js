// ---- An explanation of each number: by the pointer, by the keyboard, or by a tap ----

const EXPLAIN = {
  force: "Force into the pad: z of all taxels over the baseline, in counts; in newtons where the sensor's counts per newton are known.",
  area: "Area of the touched pixels: those near enough to the pattern's largest value, by the model's own share.",
  centroid_mm: "Centre of the touched area, weighted by depth: x to the right, y down, from the pad's centre.",
  ellipse: "Length and width of the ellipse that has the moments of the touched pixels.",
  axis: "Direction of the ellipse's long axis, from x to the right towards y down; round if it is hardly longer than wide.",
  taps_used: "Taps that the pattern was made of, and the most that the model takes.",
  another_tap: "Whether one more tap is expected to make the error smaller.",
  next_tap: "Where to touch next: half a pitch from the taps so far.",
  wrench_force: "Force on the pad along x, y and z, as the model integrates it.",
  wrench_torque: "Torque about x and y at the pad's centre.",
  wrench_twist: "Torque about the pad's normal.",
  centre_of_pressure_mm: "Point where the normal force acts; the ring on the pattern. Its line is the path of the last five seconds.",
  wrench_origin: "Where the force scale comes from: nominal is that of the average sensor.",
  trusted: "Whether the readings fit the pattern; one that is not checked, or a pattern that is not to be believed must not be acted on.",
  mismatch: "Share of the readings that the pattern does not explain.",
  tap_mismatch: "The same for each earlier tap, against the newest one.",
  interval_mm: "Nine of ten pixels are expected within this distance of the truth.",
  expected_rmse_mm: "Error of the pattern that the model itself expects.",
  gains_certainty: "How well the gains of this sensor's taxels are known.",
  rate_hz: "Scans a second from the sensor.",
  run_time_us: "Time of one inference.",
  latency_us: "Time from the scan's last byte to its pattern; of a recording there is none.",
  reused_from: "Whether the pattern was made of this scan, or the scan changed too little to make another.",
  model: "Network that makes the patterns.",
  dropped: "Scans without a pattern, since a newer one was waiting. Their force is followed all the same.",
  missed: "Scans that never came, by the sensor's own period.",
  late: "Patterns that were ready later than one scan period after their scan.",
  torn_wire: "Scans of which a part did not arrive.",
  unwritten: "Records that a slow disk or reader did not take.",
  baseline: "Short name of the zero that is subtracted.",
  baseline_origin: "Whether it was taken at the start, on demand, from this recording, or comes from a file.",
  baseline_age_s: "Time since it was taken; unknown if the clock, or a recording, does not state it.",
  drift: "Drift of the free pad since it was zeroed, mean of all taxels.",
  own: "Largest drift of a single taxel, and the latest step of its rest level.",
};

function explain(element, text) {
  element.dataset.tip = text;
  element.tabIndex = element.matches("dt:not(:first-child)") ? -1 : 0; // one stop of the tab key for a list, whose arrow keys go on
  element.setAttribute("aria-description", text);
}

const tip = {
  of: null,
  show(element) {
    const bubble = byId("tip");
    this.of = element;
    say(bubble, element.dataset.tip);
    show(bubble, true);
    const [box, own] = [element.getBoundingClientRect(), bubble.getBoundingClientRect()];
    const below = box.bottom + 6 + own.height < innerHeight;
    bubble.style.left = `${Math.max(8, Math.min(box.left, innerWidth - own.width - 8))}px`;
    bubble.style.top = `${below ? box.bottom + 6 : Math.max(8, box.top - own.height - 6)}px`;
  },
  hide() { this.of = null; show(byId("tip"), false); },
  listen() {
    const about = (event) => event.target.closest?.("[data-tip]") ?? null;
    document.addEventListener("pointerover", (event) => {
      if (event.pointerType !== "mouse") return;
      const element = about(event);
      if (element !== null) this.show(element); else if (this.of !== null) this.hide();
    });
    document.addEventListener("click", (event) => {
      const element = about(event);
      if (element !== null) this.show(element); else this.hide();
    });
    document.addEventListener("focusin", (event) => { if (about(event) !== null && event.target.matches(":focus-visible")) this.show(about(event)); });
    document.addEventListener("focusout", () => this.hide());
    document.addEventListener("scroll", () => this.hide(), { passive: true });
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.hide();
      const terms = event.target.matches?.("dt") ? [...event.target.parentElement.querySelectorAll("dt")] : [];
      const to = terms[terms.indexOf(event.target) + ({ ArrowDown: 1, ArrowUp: -1 }[event.key] ?? NaN)];
      if (to === undefined) return;
      event.preventDefault();
      to.focus({ focusVisible: true });
    });
  },
};
