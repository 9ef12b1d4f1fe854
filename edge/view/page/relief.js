// ---- Relief: the pattern as a surface, seen from above at a slant ----

const RELIEF_SHARE = 0.3; // height of the scale's end, as a share of the width
const LIGHT = [-0.5, -0.6, 0.62];

/** Paint the surface from its far edge to its near one, in the colours of the map and lit from the upper left. */
function paintRelief(canvas, { values, shape: [rows, cols] }, high, table) {
  const [context, width, height] = blank(canvas);
  if (width === 0) return;
  const rise = RELIEF_SHARE * width;
  const [across, along] = [0.86 * width, 0.56 * height];
  const value = (row, col) => Math.max(0, Math.min(1.2, values[row * cols + col] / high));
  const place = (row, col) => {
    const near = row / (rows - 1);
    const span = across * (0.8 + 0.2 * near);
    return [width / 2 + (col / (cols - 1) - 0.5) * span, 0.36 * height + near * along - value(row, col) * rise];
  };
  const steep = (RELIEF_SHARE * cols) / 1.4;
  for (let row = 0; row < rows - 1; row++) {
    for (let col = 0; col < cols - 1; col++) {
      const corners = [[row, col], [row, col + 1], [row + 1, col + 1], [row + 1, col]];
      const [a, b, c, d] = corners.map(([r, k]) => value(r, k));
      const slope = [-(b + c - a - d) * 0.5 * steep, -(c + d - a - b) * 0.5 * steep, 1];
      const lit = (slope[0] * LIGHT[0] + slope[1] * LIGHT[1] + LIGHT[2]) / Math.hypot(...slope);
      const shade = 0.45 + 0.75 * Math.max(0, lit);
      const at = 3 * level((a + b + c + d) / 4, 1);
      context.fillStyle = `rgb(${[0, 1, 2].map((channel) => Math.min(255, Math.round(table[at + channel] * shade))).join()})`;
      context.strokeStyle = context.fillStyle;
      context.beginPath();
      corners.forEach(([r, k], corner) => context[corner === 0 ? "moveTo" : "lineTo"](...place(r, k)));
      context.closePath();
      context.fill();
      context.stroke(); // closes the hair lines between neighbours
    }
  }
}
