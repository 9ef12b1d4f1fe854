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

/** Draw a bar of a round length at the lower left of a canvas that shows so many mm across. */
function scaleBar(context, ink, widthMm, width, height) {
  const barMm = SCALE_BARS_MM.find((mm) => mm <= widthMm / 3) ?? widthMm;
  const bar = (barMm / widthMm) * width;
  haloed(context, ink, 2, () => {
    context.moveTo(10, height - 16);
    context.lineTo(10, height - 10);
    context.lineTo(10 + bar, height - 10);
    context.lineTo(10 + bar, height - 16);
  });
  context.font = FONT;
  context.textAlign = "center";
  haloedText(context, ink, `${barMm}${THIN}mm`, 10 + bar / 2, height - 16);
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

/** Draw where to touch next: an arrow from the pad's centre to its next place, and its outline there. */
function outlinePad(context, ink, width, height, pxPerMm, next) {
  const [dx, dy] = [next.dx_mm * pxPerMm, next.dy_mm * pxPerMm];
  arrow(context, ink, width / 2, height / 2, dx, dy);
  context.save();
  context.translate(width / 2 + dx, height / 2 + dy);
  context.rotate((next.turn_deg / 180) * Math.PI);
  context.setLineDash([6, 4]);
  haloed(context, ink, 1.5, () => context.rect(-width / 2, -height / 2, width, height));
  context.restore();
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

const SCALE_BARS_MM = [50, 20, 10, 5, 2, 1, 0.5];
const LEAST_COUNTS = 200; // so that noise at rest stays dark
const LEAST_SHEAR_COUNTS = 100;
const LEAST_MM = 0.02;
const LEAST_DEVIATION_MM = 0.01;
const FRESH_S = 0.3;
const SHEAR_SHARE = 0.4; // length of the arrow of a force that is all shear, as a share of the pattern's width
