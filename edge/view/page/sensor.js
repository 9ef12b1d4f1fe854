// ---- A sensor ----

class Sensor {
  constructor(name) {
    Object.assign(this, { result: null, receivedS: 0, zeroed: null }); // of the newest scan
    Object.assign(this, { pattern: null, deviation: null, truth: null, touched: null, touchedS: 0 }); // of the newest with a pattern
    Object.assign(this, { name, cursor: null, trace: new Trace(), silentS: null, highest: 0, noteKinds: "", dirty: true });
    const root = byId("sensor").content.firstElementChild.cloneNode(true);
    this.root = root;
    this.part = Object.fromEntries([...root.querySelectorAll("[data-part]")].map((element) => [element.dataset.part, element]));
    this.part.name.id = `sensor-${encodeURIComponent(name)}`;
    root.setAttribute("aria-labelledby", this.part.name.id);
    root.dataset.sensor = name;
    say(this.part.name, `sensor ${name}`);
    this.part.field.setAttribute("aria-label", `pattern of sensor ${name}`);
    this.part.taxels.setAttribute("aria-label", `taxels of sensor ${name}, z in colour and shear as arrows`);
    this.fields = this.addNumbers();
    this.sized = [this.part.over, this.part.shear, this.part["force-plot"], this.part["area-plot"]];
    for (const canvas of this.sized) sizes.observe(canvas);
    paintBar(this.part["pattern-bar"], PATTERN_COLOURS);
    paintBar(this.part["taxels-bar"], TAXEL_COLOURS);
    paintBar(this.part["deviation-bar"], DEVIATION_COLOURS);
    this.listen();
  }

  addNumbers() {
    const fields = {};
    for (const [title, rows] of Object.entries(NUMBERS)) {
      if (title === "Wrench" && !page.hello.wrench) continue;
      const group = document.createElement("div");
      const heading = group.appendChild(document.createElement("h3"));
      heading.textContent = title;
      const list = group.appendChild(document.createElement("dl"));
      for (const [label, key, meaning, text] of rows) {
        const term = list.appendChild(document.createElement("dt"));
        const element = list.appendChild(document.createElement("dd"));
        term.textContent = label;
        term.title = meaning;
        element.dataset.number = key;
        if (key === "force" || key === "area") term.className = element.className = "big";
        fields[key] = { element, text };
      }
      this.part.numbers.append(group);
    }
    return fields;
  }

  listen() {
    const { field, zero, span } = this.part;
    zero.onclick = () => act.zero(this.name);
    span.onclick = () => act.span();
    this.part.shear_toggle.onclick = () => act.shear();
    field.onpointermove = field.onpointerdown = (event) => {
      const box = field.getBoundingClientRect();
      this.point((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    };
    field.onpointerleave = (event) => { if (event.pointerType === "mouse") this.point(null); }; // a finger's pixel stays
  }

  remove() {
    for (const canvas of this.sized) sizes.unobserve(canvas);
    this.root.remove();
  }

  // -- frames --

  take(header, maps) {
    const first = this.result === null;
    this.silentS = null;
    this.trace.add(header.trace ?? []);
    const receivedS = nowS() - (header.age_s ?? 0);
    Object.assign(this, { result: header, receivedS, zeroed: maps.zeroed ?? null });
    if (maps.pattern) Object.assign(this, { pattern: maps.pattern, deviation: maps.deviation ?? null, truth: maps.truth ?? null, touched: header, touchedS: receivedS });
    else if (header.baseline === null) this.pattern = this.deviation = null; // no earlier pattern is valid without a baseline
    if (maps.pattern) this.highest = largest(maps.pattern.values, this.highest);
    this.logNotes(header, first);
    this.dirty = true;
  }

  /** Log notes once if only their numbers change; a step in rest level is an event of its own. */
  logNotes({ note, note_kinds = [], dead }, first) {
    const shown = note_kinds.filter((kind) => kind !== "rest_level" && kind !== "baseline_in_doubt");
    const kinds = shown.length === 0 ? "" : JSON.stringify([shown, dead]);
    if (kinds !== "" && kinds !== this.noteKinds && !(first && this.result.state === "zeroing")) {
      log(`sensor ${this.name}: ${note}`, { key: `${this.name} ${kinds}` });
    }
    this.noteKinds = kinds;
  }

  // -- reading a pixel --

  size() { return this.pattern?.shape ?? [page.hello.height, page.hello.width]; }

  point(x, y) {
    const [rows, cols] = this.size();
    const inside = x !== null && x >= 0 && x < 1 && y >= 0 && y < 1;
    this.cursor = inside ? [Math.floor(y * rows), Math.floor(x * cols)] : null;
    this.dirty = true;
    painter.ask();
  }

  reading() {
    const [rows, cols] = this.size();
    const [row, col] = this.cursor;
    const pitch = page.hello.pixel_pitch_mm;
    const place = `x ${number((col + 0.5 - cols / 2) * pitch, 1)}, y ${number((row + 0.5 - rows / 2) * pitch, 1)}${THIN}mm`;
    if (this.pattern === null) return `${place}: no pattern`;
    const unit = this.unit();
    const at = row * cols + col;
    const uncertainty = this.deviation === null ? "" : ` \u00b1 ${amount(this.deviation.values[at], 3, unit)}`;
    return `${place}: ${amount(this.pattern.values[at], 3, unit)}${uncertainty}${this.live() ? "" : ", not live"}`;
  }

  // -- state --

  unit() { return this.result?.pattern_unit || page.hello.pattern_unit || "mm"; }

  ageS() { return nowS() - this.receivedS; }
  unsure() { return this.result?.state === "baseline_in_doubt"; }

  /** True if the sensor is silent: the program reports it, or the newest result is old. */
  away() { return this.silentS !== null || (this.result !== null && this.ageS() > 1); }

  /** True if the pattern shown is of the newest scan; after a dropped scan the pattern before stays for a moment. */
  newest() {
    if (this.pattern === null) return false;
    return this.touchedS === this.receivedS || (this.result.state === "dropped" && this.receivedS - this.touchedS < 0.3);
  }

  live() { return !this.unsure() && this.newest() && page.link.up && !this.away(); }

  /** True if the pattern is shown in grey, as where the baseline is in doubt. */
  old() { return this.unsure() || (this.pattern !== null && !this.live()); }

  /** Return the result of the pattern shown if that is the newest; else the newest result. */
  made() { return this.newest() ? this.touched : this.result; }

  /** True if the pattern shown is not to be believed, also when it is old. */
  doubted() { return this.pattern !== null && this.touched.trusted === false && !this.unsure(); }

  /** Return why the pattern shown is not to be believed, or that it is not checked; null if all is well. */
  verdict() {
    if (this.doubted()) return `not to be believed: ${this.touched.untrusted_text}`;
    if (this.pattern === null || this.touched.trusted !== null) return null;
    return page.hello.checks ? `${TOO_LIGHT} whether the pattern is to be believed` : "not checked: the model has no checks";
  }

  /** Return whether forces are shown in newtons: by this sensor's own counts per newton, or by nominal ones. */
  inNewtons() { return known(this.result?.force_n) || known(page.hello.nominal_counts_per_newton); }

  forceText() {
    const own = this.result?.force_n;
    if (!this.inNewtons()) return amount(this.result?.force_counts, 0, "counts");
    return known(own) ? amount(own, 2, "N") : `${amount(nominal(this.result?.force_counts), 2, "N")} nominal`;
  }

  word() {
    if (!page.link.up) return ["lost", lostWord()];
    if (this.result === null) return ["silent", this.silentS === null ? "no scan yet" : "no scan"];
    if (this.away()) return ["silent", `no scan for ${duration(this.silentS ?? this.ageS())}`];
    if (this.unsure()) return ["doubted", "baseline in doubt"];
    if (this.newest() && this.doubted()) return ["doubted", "contact, not believed"];
    const state = this.result.state === "dropped" ? "contact" : this.result.state; // a newer scan was already waiting
    return [state, state];
  }

  // -- drawing --

  paint() {
    this.dirty = false;
    this.paintWord();
    this.paintPattern();
    this.paintTaxels();
    this.paintDeviation();
    this.paintTraces();
    this.paintNumbers();
  }

  paintWord() {
    const [state, word] = this.word();
    const { badge, why, zero } = this.part;
    const source = this.result?.source ?? page.hello.source;
    if (this.part.word.dataset.state !== state) {
      announce(`sensor ${this.name}: ${word}`);
      this.part.word.dataset.state = state;
    }
    say(this.part.word, word);
    show(badge, source !== "device");
    badge.dataset.source = source;
    say(badge, source.toUpperCase());
    say(why, this.result?.note ?? "");
    this.root.classList.toggle("lost", state === "lost" || state === "silent");
    show(zero, page.sensors.size > 1);
    zero.disabled = !page.link.up;
    this.paintLink();
  }

  paintLink() {
    const up = page.link.up && this.result !== null && !this.away();
    this.part.link.dataset.up = up ? "yes" : "no";
    const rate = this.result?.rate_hz;
    const away = this.silentS === null ? "no scan" : `no scan for ${duration(this.silentS)}`;
    say(this.part.link, !page.link.up ? "no connection" : up ? `${known(rate) ? amount(rate, 0, "scans/s") : "scans come"}` : away);
  }

  high() { return Math.max(this.highest, 0.02); }

  paintPattern() {
    const { pattern, field, stamp, over, readout } = this.part;
    const [unit, high, live] = [this.unit(), this.high(), this.live()];
    field.classList.toggle("old", this.old());
    field.dataset.live = live ? "yes" : "no";
    say(stamp, this.stampText());
    show(stamp, this.unsure() || !live);
    say(this.part["pattern-high"], `${number(high, high < 0.1 ? 3 : 2)}${THIN}${unit}, largest so far`);
    paintMap(pattern, this.pattern, high, PATTERN_COLOURS);
    const most = this.pattern !== null && live ? largest(this.pattern.values) : null;
    say(this.part["pattern-most"], most === null ? "" : `deepest ${amount(most, 3, unit)}`);
    this.paintTruth(high);
    const verdict = this.verdict();
    show(this.part.verdict, verdict !== null);
    say(this.part.verdict, verdict ?? "");
    this.root.classList.toggle("doubted", this.doubted());
    paintOver(this, over, live);
    readout.classList.toggle("read", this.cursor !== null);
    say(readout, this.cursor === null ? (matchMedia("(hover: none)").matches ? "tap the pattern to read a pixel" : "hover to read a pixel") : this.reading());
  }

  paintTruth(high) {
    const known = this.pattern !== null && this.truth !== null;
    show(this.part["truth-shown"], known);
    if (!known) return;
    paintMap(this.part.truth, this.truth, high, PATTERN_COLOURS);
    const squares = this.pattern.values.reduce((sum, value, at) => sum + (value - this.truth.values[at]) ** 2, 0);
    say(this.part["truth-error"], amount((100 * Math.sqrt(squares / this.pattern.values.length)) / (page.hello.full_scale || 1), 1, "%"));
  }

  stampText() {
    if (this.unsure()) return `${this.result.note} (key z)`;
    if (this.pattern === null) return this.result === null ? "no scan yet" : this.result.baseline === null ? this.result.note ?? "no baseline yet" : "no contact yet";
    return `last contact ${ago(nowS() - this.touchedS)}`;
  }

  paintTaxels() {
    const { taxels, shear, dead } = this.part;
    show(this.part["shear-legend"], this.zeroed !== null);
    const [context, width, height] = blank(shear);
    const deaths = Object.entries(this.result?.dead ?? {});
    show(dead, deaths.length > 0);
    say(dead, `dead, not used: ${deaths.map(([taxel, reason]) => `taxel ${taxel} ${reason}`).join(", ")}`);
    if (this.zeroed === null) {
      paintMap(taxels, null);
      say(this.part["taxels-high"], "counts");
    } else {
      const [, rows, cols] = this.zeroed.shape;
      const [count, values] = [rows * cols, this.zeroed.values];
      const z = values.subarray(2 * count, 3 * count);
      const believed = Array.from(z, (value, taxel) => (this.result.dead?.[taxel] ? 0 : value));
      const high = roundUp(largest(believed, LEAST_COUNTS));
      paintMap(taxels, { values: z, shape: [rows, cols] }, high, TAXEL_COLOURS);
      say(this.part["taxels-high"], `${short(high)}${THIN}counts`);
      if (width > 0) paintShear(this, context, width, height, rows, cols, values, high);
    }
    const [rows, cols] = [page.hello.rows, page.hello.cols];
    for (const [taxel] of deaths) cross(context, width, height, rows, cols, Number(taxel));
  }

  paintDeviation() {
    const { deviation } = this.part;
    const [field, stamp] = [this.part["deviation-field"], this.part["deviation-stamp"]];
    field.classList.toggle("old", this.old());
    show(stamp, this.deviation === null);
    say(stamp, this.pattern !== null ? "not given by this model" : "no contact yet");
    const high = this.deviation === null ? null : roundUp(largest(this.deviation.values, 0.01));
    paintMap(deviation, this.deviation, high, DEVIATION_COLOURS);
    say(this.part["deviation-high"], high === null ? this.unit() : `${short(high)}${THIN}${this.unit()}`);
  }

  paintTraces() {
    const newtons = this.inNewtons();
    const span = page.spanS;
    say(this.part.span, `last ${span}${THIN}s`);
    paintTrace(this.part["force-plot"], this.trace, "force", span, newtons ? 1 : 1000, colour("force"), newtons ? "N" : "counts");
    if (page.shear && page.hello.wrench) paintTrace(this.part["area-plot"], this.trace, "shear_ratio", span, 0.5, colour("area"), "shear / force");
    else paintTrace(this.part["area-plot"], this.trace, "area_mm2", span, 50, colour("area"), "mm\u00b2");
    show(this.part.shear_toggle, page.hello.wrench);
    this.part.shear_toggle.setAttribute("aria-pressed", String(page.shear));
    say(this.part["force-now"], this.forceText());
    say(this.part["area-now"], amount(this.made()?.area_mm2, 0, "mm\u00b2"));
  }

  paintNumbers() {
    const result = this.result;
    const made = this.made();
    if (result === null) return;
    const counters = result.counters ?? {};
    for (const [key, { element, text }] of Object.entries(this.fields)) {
      say(element, text?.({ sensor: this, result, made }) ?? String(counters[key] ?? 0));
      // Fewer losses, as in the first second of a run, are no reason to worry.
      if (!text) element.classList.toggle("warn", counters[key] > 0.01 * (counters.scans ?? 0));
    }
    this.fields.trusted.element.classList.toggle("warn", made.trusted === false);
    this.fields.baseline_age_s.element.classList.toggle("warn", result.baseline !== null && !known(result.baseline_age_s));
  }
}
