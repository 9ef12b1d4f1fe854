// ---- Marks over the pattern and the taxels ----

/** Draw the marks over a pattern; those of a contact only where the pattern is of the moment shown. */
function paintOver(sensor, canvas, current) {
  const [context, width, height] = blank(canvas);
  const [rows, cols] = sensor.size();
  const widthMm = cols * sensor.hello.pixel_pitch_mm;
  if (!(widthMm > 0) || width === 0) return;
  const ink = sensor.pattern === null ? [colour("text"), colour("card")] : ["#fff", "#0009"];
  scaleBar(context, ink, widthMm, width, height);
  const place = ([xMm, yMm]) => [width / 2 + (xMm / widthMm) * width, height / 2 + (yMm / widthMm) * width];
  const ellipse = current && !sensor.doubted() ? sensor.ellipse() : null;
  if (ellipse !== null) drawEllipse(context, ink, place, width / widthMm, ellipse);
  if (current) sensor.path.draw(context, ink, place, page.atS ?? sensor.trace.newestS);
  const centre = current ? sensor.touched.centroid_mm : null;
  if (centre) {
    const [x, y] = place(centre);
    haloed(context, ink, 1.5, () => { context.moveTo(x - 6, y); context.lineTo(x + 6, y); context.moveTo(x, y - 6); context.lineTo(x, y + 6); });
  }
  const wrench = current ? sensor.touched.wrench : null;
  if (wrench?.centre_of_pressure_mm) {
    const [x, y] = place(wrench.centre_of_pressure_mm);
    const [fx, fy] = wrench.force_n;
    const length = (SHEAR_SHARE * width) / Math.hypot(...wrench.force_n);
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
  let longest = LEAST_SHEAR_COUNTS;
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
