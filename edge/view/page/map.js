// ---- The map of the object, larger than the pad ----

class MapPane {
  constructor() {
    Object.assign(this, { header: null, shown: null, contact: null, doubted: null, dirty: false });
    this.root = byId("map");
    sizes.observe(byId("map-over"));
  }

  /** Take what has changed; the first frame of a run holds the whole map. */
  take(header, { contact, doubted }) {
    const count = header.pixels;
    if (this.contact === null || this.header.pixels !== count) {
      this.contact = new Float32Array(count * count).fill(NaN);
      this.doubted = new Float32Array(count * count);
    }
    this.header = header;
    const [top, left] = header.from;
    if (contact) {
      const [rows, cols] = contact.shape;
      for (let row = 0; row < rows; row++) {
        const to = (top + row) * count + left;
        this.contact.set(contact.values.subarray(row * cols, (row + 1) * cols), to);
        this.doubted.set(doubted.values.subarray(row * cols, (row + 1) * cols), to);
      }
    }
    this.dirty = true;
  }

  forget() {
    Object.assign(this, { header: null, contact: null, doubted: null, dirty: true });
  }

  paint() {
    this.dirty = false;
    show(this.root, this.header !== null);
    this.shown = this.header;
    if (this.header === null) return;
    const { pixels, counts } = this.header;
    this.paintContact(byId("map-contact"), pixels);
    paintBar(byId("map-bar"), VIRIDIS);
    const fates = { doubted: "not believed", light: "too light", outside: "outside the map", without_pose: "without a pose", together: "of two pads at one place" };
    const left = Object.entries(fates).filter(([key]) => counts[key] > 0).map(([key, why]) => `${counts[key]} ${why}`);
    const mark = page.hello?.source === "emulated" ? "EMULATED: " : "";
    say(byId("map-counts"), `${mark}${[`${counts.fused} patterns`, ...left].join(", ")}`);
    show(byId("map-empty"), counts.fused === 0);
    say(byId("map-empty"), counts.without_pose > 0 ? "no poses come: send those of the pad" : "nothing touched yet");
    this.paintPads();
  }

  paintContact(canvas, count) {
    if (canvas.width !== count) [canvas.width, canvas.height] = [count, count];
    const context = canvas.getContext("2d");
    const image = context.createImageData(count, count);
    for (let pixel = 0; pixel < count * count; pixel++) {
      const unknown = Number.isNaN(this.contact[pixel]);
      if (unknown && !(this.doubted[pixel] > 0)) continue; // transparent
      const at = 3 * level(this.contact[pixel], 1);
      image.data.set(unknown ? [200, 40, 30, 255] : [VIRIDIS[at], VIRIDIS[at + 1], VIRIDIS[at + 2], 255], 4 * pixel);
    }
    context.putImageData(image, 0, 0);
  }

  /** Draw the outline of each pad where it was when the map was painted, with a mark at the end of its x axis. */
  paintPads() {
    const [context, width, height] = blank(byId("map-over"));
    if (width === 0 || page.hello === null || this.shown === null) return;
    const sizeMm = this.shown.pixels / this.shown.px_per_mm;
    const { rows, cols, taxel_pitch_mm: pitch } = page.hello;
    const [halfX, halfY] = [(cols * pitch) / 2, (rows * pitch) / 2];
    const [centreX, centreY] = this.shown.centre_mm;
    const ink = ["#fff", "#000a"];
    for (const [x, y, turn] of Object.values(this.shown.pads)) {
      const [cosine, sine] = [Math.cos((turn * Math.PI) / 180), Math.sin((turn * Math.PI) / 180)];
      const place = (right, down) => [
        width / 2 + ((x - centreX + cosine * right - sine * down) / sizeMm) * width,
        height / 2 + ((y - centreY + sine * right + cosine * down) / sizeMm) * height,
      ];
      haloed(context, ink, 1.5, () => {
        context.moveTo(...place(-halfX, -halfY));
        for (const corner of [[halfX, -halfY], [halfX, halfY], [-halfX, halfY]]) context.lineTo(...place(...corner));
        context.closePath();
        context.moveTo(...place(halfX, 0));
        context.lineTo(...place(halfX - 2, 0));
      });
    }
    scaleBar(context, ink, sizeMm, width, height);
  }
}
