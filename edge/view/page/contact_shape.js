// ---- Shape of the contact: its ellipse, and the path of its centre ----

const WHOLE_SHARE = 0.9; // of the pad
const PATH_S = 5;
const PATH_POINTS = 600;

/** Return the ellipse with the moments of the touched pixels: centre and half axes in mm, and the turn of the long one in degrees; null without any, or if they fill the pad. */
function contactEllipse({ values, shape: [rows, cols] }, pitchMm, share) {
  const least = share * largest(values);
  if (!(least > 0)) return null;
  let [sum, sumX, sumY, sumXx, sumXy, sumYy] = [0, 0, 0, 0, 0, 0];
  for (let row = 0, at = 0; row < rows; row++) {
    for (let col = 0; col < cols; col++, at++) {
      if (values[at] < least) continue;
      sum += 1; sumX += col; sumY += row; sumXx += col * col; sumXy += col * row; sumYy += row * row;
    }
  }
  if (sum > WHOLE_SHARE * rows * cols) return null; // the whole pad has no shape
  const [x, y] = [sumX / sum, sumY / sum];
  const [xx, xy, yy] = [sumXx / sum - x * x + 1 / 12, sumXy / sum - x * y, sumYy / sum - y * y + 1 / 12];
  const [mean, spread] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
  const halves = [mean + spread, Math.max(mean - spread, 0)].map((moment) => 2 * Math.sqrt(moment) * pitchMm);
  const turn = (0.5 * Math.atan2(2 * xy, xx - yy) * 180) / Math.PI;
  return { x: (x - (cols - 1) / 2) * pitchMm, y: (y - (rows - 1) / 2) * pitchMm, halves, turn, pixels: sum };
}

/** Draw the ellipse, and its long axis where it has one. */
function drawEllipse(context, ink, place, pxPerMm, { x, y, halves: [long, wide], turn }) {
  const angle = (turn * Math.PI) / 180;
  const [centreX, centreY] = place([x, y]);
  haloed(context, ink, 1.2, () => context.ellipse(centreX, centreY, long * pxPerMm, wide * pxPerMm, angle, 0, 2 * Math.PI));
  if (long < 1.15 * wide) return;
  const [dx, dy] = [Math.cos(angle) * long * pxPerMm, Math.sin(angle) * long * pxPerMm];
  context.save();
  context.setLineDash([5, 4]);
  haloed(context, ink, 1.2, () => { context.moveTo(centreX - dx, centreY - dy); context.lineTo(centreX + dx, centreY + dy); });
  context.restore();
}

const ellipseText = (ellipse) => (ellipse === null ? "\u2013" : `${number(2 * ellipse.halves[0], 1)} \u00d7 ${number(2 * ellipse.halves[1], 1)}${THIN}mm`);
const axisText = (ellipse) => (ellipse === null ? "\u2013" : ellipse.halves[0] < 1.15 * ellipse.halves[1] ? "round" : `${number(ellipse.turn)}\u00b0`);

/** Path of the centre of pressure, or of the touched area where the model gives no force. */
class Path {
  constructor() { this.points = []; }

  add(atS, { state, trusted, wrench, centroid_mm: centroid }) {
    if (!known(atS)) return;
    const touched = state === "contact" && trusted !== false;
    const centre = touched ? wrench?.centre_of_pressure_mm ?? centroid : null;
    if (!centre && this.points.at(-1)?.[1] === null) return; // one point parts two contacts
    this.points.push([atS, centre ?? null]);
    if (this.points.length > PATH_POINTS) this.points.shift();
  }

  draw(context, ink, place, endS) {
    const shown = this.points.filter(([atS]) => atS <= endS + 1e-6 && endS - atS <= PATH_S);
    haloed(context, ink, 1.2, () => {
      let drawing = false;
      for (const [, centre] of shown) {
        if (centre !== null) context[drawing ? "lineTo" : "moveTo"](...place(centre));
        drawing = centre !== null;
      }
    });
  }
}
