// ---- Limits of force and area that this page watches ----

const LIMITED = { force: ["force_n", "force_counts"], area: ["area_mm2"] };

/** Watch of one sensor's newest values; a limit is kept by the browser, for each unit and for all sensors. */
class Limits {
  constructor(sensor) {
    Object.assign(this, { sensor, over: {} });
    for (const what of Object.keys(LIMITED)) {
      const field = sensor.part[`${what}-limit`];
      field.setAttribute("aria-label", `limit of the ${what}, above which this page marks it`);
      explain(field, `mark the ${what}, here and in the log, when it is above this limit; it stops no robot`);
      field.onchange = () => {
        memory.set(this.key(what), field.value);
        for (const other of page.sensors.values()) other.limits.watch();
        painter.all();
      };
    }
  }

  /** Return the field of the result that is watched. */
  field(what) { return LIMITED[what].find((name) => this.sensor.result?.[name] != null) ?? LIMITED[what].at(-1); }

  key(what) { return `limit ${this.field(what)}`; }

  /** Return the limit; null where none is set. */
  of(what) {
    const limit = Number(memory.get(this.key(what)));
    return limit > 0 ? limit : null;
  }

  /** Compare the newest values, and log each time that one has risen above its limit. */
  watch() {
    const newest = this.sensor.later?.result ?? this.sensor.result; // also while a person looks back
    for (const what of Object.keys(LIMITED)) {
      const [limit, value] = [this.of(what), newest?.[this.field(what)] ?? null];
      const over = limit !== null && value !== null && value > limit;
      if (over && !this.over[what]) log(`sensor ${this.sensor.name}: ${what} above the limit of ${limit}`, { bad: true });
      this.over[what] = over;
    }
  }

  paint() {
    for (const what of Object.keys(LIMITED)) {
      const field = this.sensor.part[`${what}-limit`];
      if (document.activeElement !== field) field.value = this.of(what) ?? "";
      field.closest("div").dataset.over = this.over[what] ? "yes" : "no";
    }
    this.sensor.root.dataset.over = Object.values(this.over).some(Boolean) ? "yes" : "no";
  }
}

/** Draw a limit over a plot. */
function paintLimit(context, limit, y, left, right) {
  if (limit === null) return;
  context.save();
  context.strokeStyle = colour("bad");
  context.setLineDash([5, 4]);
  context.lineWidth = 1.2;
  context.beginPath();
  context.moveTo(left, y(limit));
  context.lineTo(right, y(limit));
  context.stroke();
  context.restore();
}
