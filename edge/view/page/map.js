// ---- The map of the object, larger than the pad ----

class MapPane {
  constructor() {
    Object.assign(this, { header: null, shown: null, contact: null, dirty: false });
    this.root = byId("map");
    sizes.observe(byId("map-over"));
  }

  take(header, { contact }) { Object.assign(this, { header, contact, dirty: true }); }

  forget() { Object.assign(this, { header: null, contact: null, dirty: true }); }

  paint() {
    this.dirty = false;
    show(this.root, this.header !== null);
    this.shown = this.header;
    if (this.header === null) return;
    const { counts } = this.header;
    paintMap(byId("map-contact"), this.contact, 1, PATTERN_COLOURS, [200, 40, 30]); // not believed: red
    paintBar(byId("map-bar"), PATTERN_COLOURS);
    const fates = { doubted: "not believed", light: "too light", outside: "outside the map", without_pose: "without a pose", together: "of two pads at one place" };
    const left = Object.entries(fates).filter(([key]) => counts[key] > 0).map(([key, why]) => `${counts[key]} ${why}`);
    const mark = page.hello?.source === "emulated" ? "EMULATED: " : "";
    say(byId("map-counts"), `${mark}${[`${counts.fused} patterns`, ...left].join(", ")}`);
    show(byId("map-empty"), counts.fused === 0);
    say(byId("map-empty"), counts.without_pose > 0 ? "no poses come: send those of the pad" : "nothing touched yet");
    this.paintPads();
  }

  /** Draw the outline of each pad where it was when the map was painted, with a mark at the end of its x axis. */
  paintPads() {
    const [context, width, height] = blank(byId("map-over"));
    if (width === 0 || page.hello === null || this.shown === null) return;
    const sizeMm = this.shown.size_mm;
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
