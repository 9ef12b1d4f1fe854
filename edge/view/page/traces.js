// ---- Traces ----

const STEP_S = 0.01; // closer scans share a point, which keeps the larger value
const GAP_S = 0.3;
const POINTS = 66 / STEP_S; // the longest span, and some more

/** Return the force of counts in newtons by the nominal sensitivity; as counts where the model states none. */
const nominal = (counts) => (known(counts) ? counts / (page.hello.nominal_counts_per_newton ?? 1) : null);

/** Ring buffer of the last minute of force, area and shear. */
class Trace {
  constructor() {
    this.time = new Float64Array(POINTS);
    this.series = { force: new Float32Array(POINTS), area_mm2: new Float32Array(POINTS), shear_ratio: new Float32Array(POINTS) };
    this.next = this.count = 0;
    this.newestS = -Infinity;
  }

  add(points) {
    for (const [atS, forceCounts, areaMm2, forceN, shearRatio] of points) {
      if (atS < this.newestS) continue; // a new connection gets the last minute again
      const same = this.count > 0 && atS - this.newestS < 0.5 * STEP_S;
      const place = same ? (this.next + POINTS - 1) % POINTS : this.next;
      const values = [forceN ?? nominal(forceCounts), areaMm2, shearRatio];
      Object.values(this.series).forEach((series, which) => {
        const value = values[which] ?? NaN;
        series[place] = same && !(value > series[place]) && !Number.isNaN(series[place]) ? series[place] : value;
      });
      if (same) continue;
      this.time[place] = this.newestS = atS;
      this.next = (place + 1) % POINTS;
      this.count = Math.min(this.count + 1, POINTS);
    }
  }

  /** Call visit(time, value) for each point of the last `spanS` seconds, oldest first. */
  each(name, spanS, visit) {
    const series = this.series[name];
    for (let back = this.count; back > 0; back--) {
      const place = (this.next + POINTS - back) % POINTS;
      const atS = this.time[place];
      if (this.newestS - atS <= spanS) visit(atS, series[place]);
    }
  }
}

/** Observer of the sizes of canvases, in device pixels; to query a size would cost a layout. */
const sizes = new ResizeObserver((entries) => {
  for (const { target, contentRect } of entries) {
    const ratio = window.devicePixelRatio;
    [target.width, target.height] = [Math.round(contentRect.width * ratio), Math.round(contentRect.height * ratio)];
  }
  painter.resized();
});

function blank(canvas) {
  const context = canvas.getContext("2d");
  const ratio = window.devicePixelRatio;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  return [context, canvas.width / ratio, canvas.height / ratio];
}

const FONT = '11px system-ui, "DejaVu Sans", sans-serif';

/** Paint a trace up to now. */
function paintTrace(canvas, trace, name, spanS, least, ink, unit) {
  const [context, width, height] = blank(canvas);
  const [left, right, top, bottom] = [40, width - 6, 7, height - 17];
  if (right <= left) return;
  let [low, high] = [0, least];
  trace.each(name, spanS, (_, value) => { if (value > high) high = value; if (value < low) low = value; });
  high = roundUp(1.03 * high);
  low = low < -0.02 * high ? -roundUp(-low) : 0;
  const x = (atS) => right - ((trace.newestS - atS) / spanS) * (right - left);
  const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
  context.font = FONT;
  context.fillStyle = colour("quiet");
  context.strokeStyle = colour("grid");
  context.lineWidth = 1;
  context.beginPath();
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of low < 0 ? [low, 0, high] : [0, high / 2, high]) {
    context.moveTo(left, Math.round(y(value)) + 0.5);
    context.lineTo(right, Math.round(y(value)) + 0.5);
    context.fillText(short(value), left - 5, y(value));
  }
  context.textBaseline = "alphabetic";
  for (let part = 0; part <= 2; part++) {
    const at = Math.round(right - (part / 2) * (right - left)) - 0.5;
    context.moveTo(at, top);
    context.lineTo(at, bottom);
    context.textAlign = part === 0 ? "right" : part === 2 ? "left" : "center";
    context.fillText(part === 0 ? "now" : `${MINUS}${(spanS * part) / 2}${THIN}s`, at, height - 4);
  }
  context.stroke();
  context.textAlign = "left";
  context.fillText(unit, left + 4, top + 9);
  paintLine(context, trace, name, spanS, x, y, ink);
}

/** Draw a line through all points; those on one column are one stroke from the least to the largest. */
function paintLine(context, trace, name, spanS, x, y, ink) {
  context.strokeStyle = ink;
  context.lineWidth = 1.6;
  context.lineJoin = "round";
  context.beginPath();
  let [column, beforeS, drawing] = [null, -Infinity, false];
  let [least, most] = [0, 0];
  trace.each(name, spanS, (atS, value) => {
    if (Number.isNaN(value)) { drawing = false; return; }
    const at = Math.round(2 * x(atS)) / 2;
    if (!drawing || atS - beforeS > GAP_S) {
      context.moveTo(at, y(value));
      [column, least, most, drawing] = [at, value, value, true];
    } else if (at !== column || value > most || value < least) {
      context.lineTo(at, y(value));
      [least, most] = at === column ? [Math.min(least, value), Math.max(most, value)] : [value, value];
      column = at;
    }
    beforeS = atS;
  });
  context.stroke();
}
