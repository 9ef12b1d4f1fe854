// ---- Colours: a few stops of maps that grow steadily lighter, and are readable for the colour-blind ----

const STOPS = {
  viridis: "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
  cividis: "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
  magma: "000004 180f3d 440f76 721f81 9e2f7f cd4071 f1605d fd9668 feca8d fcfdbf",
};
const LEVELS = 256;

/** Return 256 colours, as red, green and blue one after the other. */
function colourTable(name) {
  const stops = STOPS[name].split(" ").map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  const table = new Uint8ClampedArray(3 * LEVELS);
  for (let level = 0; level < LEVELS; level++) {
    const place = (level / (LEVELS - 1)) * (stops.length - 1);
    const lower = Math.min(Math.floor(place), stops.length - 2);
    for (let channel = 0; channel < 3; channel++) {
      const [from, to] = [stops[lower][channel], stops[lower + 1][channel]];
      table[3 * level + channel] = from + (to - from) * (place - lower);
    }
  }
  return table;
}

const PATTERN_COLOURS = colourTable("viridis");
const TAXEL_COLOURS = colourTable("cividis");
const DEVIATION_COLOURS = colourTable("magma");

const level = (value, high) => Math.max(0, Math.min(LEVELS - 1, Math.round((value / high) * (LEVELS - 1))));

/** Paint one canvas pixel for each value of a map, which the style sheet enlarges; NaN is transparent, values below 0 have the colour `below`, if any, and null clears the canvas. */
function paintMap(canvas, map, high, table, below = null) {
  const context = canvas.getContext("2d");
  if (map === null) return context.clearRect(0, 0, canvas.width, canvas.height);
  const [rows, cols] = map.shape;
  if (canvas.width !== cols || canvas.height !== rows) [canvas.width, canvas.height] = [cols, rows];
  const image = context.createImageData(cols, rows);
  map.values.forEach((value, pixel) => {
    const at = 3 * level(value, high);
    for (let channel = 0; channel < 3; channel++) image.data[4 * pixel + channel] = value < 0 && below ? below[channel] : table[at + channel];
    image.data[4 * pixel + 3] = Number.isNaN(value) ? 0 : 255;
  });
  return context.putImageData(image, 0, 0);
}

const paintBar = (canvas, table) => paintMap(canvas, { values: Float32Array.from({ length: LEVELS }, (_, at) => at), shape: [1, LEVELS] }, LEVELS - 1, table);

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
  const barMm = [50, 20, 10, 5, 2, 1, 0.5].find((mm) => mm <= widthMm / 3) ?? widthMm;
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

const LEAST_COUNTS = 200; // so that noise at rest stays dark

// ---- Marks over the pattern and the taxels ----

/** Draw the marks over a pattern; those of a contact only where the pattern is of the moment shown. */
function paintOver(sensor, canvas, current) {
  const [context, width, height] = blank(canvas);
  const [rows, cols] = sensor.size();
  const widthMm = cols * page.hello.pixel_pitch_mm;
  if (!(widthMm > 0) || width === 0) return;
  const ink = sensor.pattern === null ? [colour("text"), colour("card")] : ["#fff", "#0009"];
  scaleBar(context, ink, widthMm, width, height);
  const place = ([xMm, yMm]) => [width / 2 + (xMm / widthMm) * width, height / 2 + (yMm / widthMm) * width];
  const centre = current ? sensor.touched.centroid_mm : null;
  if (centre) {
    const [x, y] = place(centre);
    haloed(context, ink, 1.5, () => { context.moveTo(x - 6, y); context.lineTo(x + 6, y); context.moveTo(x, y - 6); context.lineTo(x, y + 6); });
  }
  const wrench = current ? sensor.touched.wrench : null;
  if (wrench?.centre_of_pressure_mm) {
    const [x, y] = place(wrench.centre_of_pressure_mm);
    const [fx, fy] = wrench.force_n;
    const length = (0.4 * width) / Math.hypot(...wrench.force_n); // of the arrow of a force that is all shear: 0.4 of the width
    haloed(context, ink, 1.5, () => context.arc(x, y, 5, 0, 2 * Math.PI));
    arrow(context, ink, x, y, fx * length, fy * length);
  }
  const next = sensor.pattern === null || sensor.away() || !page.link.up ? null : sensor.result?.next_tap;
  if (next) outlinePad(context, ink, width, height, width / widthMm, next);
  if (sensor.cursor !== null) {
    const [row, col] = sensor.cursor;
    haloed(context, ink, 2, () => context.rect((col * width) / cols, (row * height) / rows, width / cols, height / rows));
  }
}

function paintShear(sensor, context, width, height, rows, cols, values, high) {
  const count = rows * cols;
  let longest = 100;
  for (let taxel = 0; taxel < count; taxel++) {
    if (!sensor.result.dead?.[taxel]) longest = Math.max(longest, Math.hypot(values[taxel], values[count + taxel]));
  }
  longest = roundUp(longest);
  const cell = Math.min(width / cols, height / rows);
  sensor.part.ruler.style.width = `${0.45 * cell}px`;
  say(sensor.part["shear-most"], `${short(longest)}${THIN}counts`);
  context.font = '10px system-ui, "DejaVu Sans", sans-serif';
  context.textAlign = "center";
  for (let taxel = 0; taxel < count; taxel++) {
    if (sensor.result.dead?.[taxel]) continue;
    const [x, y] = [((taxel % cols) + 0.5) * (width / cols), (Math.floor(taxel / cols) + 0.5) * (height / rows)];
    const z = values[2 * count + taxel];
    const ink = level(z, high) > 0.6 * LEVELS ? ["#000", "#fff6"] : ["#fff", "#0006"];
    arrow(context, ink, x, y, (values[taxel] / longest) * 0.45 * cell, (values[count + taxel] / longest) * 0.45 * cell);
    if (cell > 34) {
      context.fillStyle = ink[0];
      context.fillText(number(z), x, y + cell / 2 - 4);
    }
  }
}
