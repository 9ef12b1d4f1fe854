// ---- Marks on maps ----

/** Draw a path in one ink over a wider one, so that it is visible on any background. */
function haloed(context, [ink, halo], width, path) {
  for (const [strokeStyle, lineWidth] of [[halo, width + 2], [ink, width]]) {
    Object.assign(context, { strokeStyle, lineWidth });
    context.beginPath();
    path();
    context.stroke();
  }
}

function haloedText(context, [ink, halo], text, x, y) {
  Object.assign(context, { strokeStyle: halo, lineWidth: 3, fillStyle: ink, lineJoin: "round" });
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}

function arrow(context, ink, x, y, dx, dy) {
  const length = Math.hypot(dx, dy);
  haloed(context, ink, 1.6, () => {
    context.moveTo(x, y);
    context.lineTo(x + dx, y + dy);
    if (length > 4) {
      const [along, across] = [[dx / length, dy / length], [-dy / length, dx / length]];
      const head = Math.min(5, length / 2);
      for (const side of [-1, 1]) {
        context.moveTo(x + dx, y + dy);
        context.lineTo(x + dx - head * (along[0] + 0.6 * side * across[0]), y + dy - head * (along[1] + 0.6 * side * across[1]));
      }
    }
  });
  context.beginPath();
  context.fillStyle = ink[0];
  context.arc(x, y, 1.8, 0, 2 * Math.PI);
  context.fill();
}

/** Cover a taxel that is left out, rather than only mark it: its colour means nothing. */
function cross(context, width, height, rows, cols, taxel) {
  const [w, h] = [width / cols, height / rows];
  const [x, y] = [(taxel % cols) * w, Math.floor(taxel / cols) * h];
  context.fillStyle = "#111";
  context.fillRect(x, y, w, h);
  haloed(context, ["#ff8a7d", "#0008"], 2.5, () => {
    const edge = 0.22;
    context.moveTo(x + edge * w, y + edge * h);
    context.lineTo(x + (1 - edge) * w, y + (1 - edge) * h);
    context.moveTo(x + (1 - edge) * w, y + edge * h);
    context.lineTo(x + edge * w, y + (1 - edge) * h);
  });
}

function thumb(tap) {
  const item = document.createElement("li");
  const canvas = item.appendChild(document.createElement("canvas"));
  [canvas.width, canvas.height] = [4, 4];
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", tap === 0 ? "this tap" : `${tap} taps before`);
  item.append(tap === 0 ? "now" : `${MINUS}${tap}`);
  return item;
}

// ---- Numbers of a sensor ----

const NUMBERS = {
  Touch: [
    ["force", "force", "big"], ["area", "area", "big"], ["centre", "centroid_mm"], ["taps used", "taps_used"], ["another tap", "another_tap"],
  ],
  Wrench: [
    ["force x y z", "wrench_force"], ["torque x y", "wrench_torque"], ["twist", "wrench_twist"], ["pressure at", "centre_of_pressure_mm"],
    ["sensitivity", "wrench_origin"],
  ],
  Doubt: [["90 % within", "interval_mm"], ["expected RMSE", "expected_rmse_mm"], ["pattern", "reused_from"], ["gains", "gains_certainty"]],
  Pace: [["rate", "rate_hz"], ["run time", "run_time_us"], ["latency", "latency_us"], ["model", "model"]],
  Losses: [["dropped", "dropped"], ["missed", "missed"], ["late", "late"], ["torn on the wire", "torn_wire"], ["unwritten", "unwritten"]],
  Baseline: [["which", "baseline"], ["from", "baseline_origin"], ["age", "baseline_age_s"], ["drift x y z", "drift"], ["own, step", "own"]],
};
const LOSSES = new Set(["dropped", "missed", "late", "torn_wire", "unwritten"]);
const ORIGINS = { "start-up": "start-up", file: "file", demand: "on demand" };
const SCALE_BARS_MM = [50, 20, 10, 5, 2, 1, 0.5];
const LEAST_COUNTS = 200; // so that noise at rest stays dark
const LEAST_SHEAR_COUNTS = 100;
const LEAST_MM = 0.02;
const LEAST_DEVIATION_MM = 0.01;
const FRESH_S = 0.3;
const SHEAR_SHARE = 0.4; // length of the arrow of a force that is all shear, as a share of the pattern's width

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
