// ---- The last minutes, kept in the browser ----

const HISTORY_S = 180;
const HISTORY_STEP_S = 0.09; // some ten frames a second
const HISTORY_BYTES = 96e6; // of all sensors together

/** Frames of one sensor as they came, unpacked only when they are shown. */
class History {
  constructor() { Object.assign(this, { frames: [], bytes: 0 }); }

  get oldestS() { return this.frames[0]?.atS ?? Infinity; }

  get newestS() { return this.frames.at(-1)?.atS ?? -Infinity; }

  add(atS, buffer, mostBytes) {
    if (!known(atS) || atS - this.newestS < HISTORY_STEP_S) return;
    this.frames.push({ atS, buffer });
    this.bytes += buffer.byteLength;
    let old = 0;
    while (old < this.frames.length - 1 && (this.bytes > mostBytes || this.frames[old].atS < atS - HISTORY_S)) this.bytes -= this.frames[old++].buffer.byteLength;
    if (old > 0) this.frames.splice(0, old);
  }

  /** Return the place of the newest frame at this time or before; -1 if there is none. */
  place(atS) {
    let [low, high] = [0, this.frames.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.frames[middle].atS <= atS + 1e-6) low = middle + 1; else high = middle;
    }
    return low - 1;
  }

  /** Return the frame shown at this time; null if the sensor sent none in the second before. */
  at(atS) {
    const frame = this.frames[this.place(atS)];
    return frame && atS - frame.atS < 1 ? { ...unpack(frame.buffer), atS: frame.atS } : null;
  }
}

// ---- Looking back: live goes on meanwhile ----

const past = {
  newestS: () => Math.max(...[...page.sensors.values()].map((sensor) => sensor.trace.newestS), -Infinity),
  oldestS: () => Math.min(...[...page.sensors.values()].map((sensor) => sensor.history.oldestS), Infinity),

  show(atS) {
    const [oldest, newest] = [this.oldestS(), this.newestS()];
    if (!Number.isFinite(oldest)) return;
    page.atS = Math.max(oldest, Math.min(atS, newest));
    for (const sensor of page.sensors.values()) sensor.recall(page.atS);
    painter.all();
  },

  live() {
    if (page.atS === null) return;
    page.atS = null;
    for (const sensor of page.sensors.values()) sensor.comeBack();
    painter.all();
  },

  /** Step to the next or the previous frame of any sensor; past the newest is live. */
  step(by) {
    if (page.atS === null && by > 0) return;
    const from = page.atS ?? this.newestS();
    const times = [...page.sensors.values()].flatMap(({ history }) => {
      const at = history.place(from);
      return [at - 1, at, at + 1].map((place) => history.frames[place]?.atS);
    }).filter((atS) => known(atS) && (by < 0 ? atS < from - 1e-4 : atS > from + 1e-4));
    if (times.length > 0) this.show(by < 0 ? Math.max(...times) : Math.min(...times));
    else if (by > 0) this.live();
  },

  paint() {
    const [oldest, newest] = [this.oldestS(), this.newestS()];
    const slider = byId("back");
    const there = Number.isFinite(oldest) && newest > oldest;
    show(byId("history"), there);
    if (!there) return;
    if (page.atS !== null && page.atS < oldest) this.show(oldest);
    slider.min = String(oldest - newest);
    if (page.atS === null) slider.value = "0";
    else if (document.activeElement !== slider || !slider.matches(":active")) slider.value = String(page.atS - newest);
    const text = page.atS === null ? `live; ${duration(newest - oldest)} kept` : `${number(newest - page.atS, 1)}${THIN}s ago`;
    say(byId("back-text"), text);
    slider.setAttribute("aria-valuetext", text);
    byId("to-live").disabled = page.atS === null;
  },
};

// ---- The recording that is played ----

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

const replay = {
  at: null, // {at_s, receivedS} of the newest state
  dragged: false,

  take(state) { this.at = state === null || state === undefined ? null : { ...state, receivedS: nowS() }; },

  get rests() { return this.at !== null && (this.at.paused || this.at.waiting); },

  placeS() {
    const { at_s: atS, length_s: lengthS, speed, receivedS } = this.at;
    return this.rests || !page.link.up ? atS : Math.min(lengthS, atS + (nowS() - receivedS) * speed);
  },

  play(on) { command({ cmd: "play", on }); },

  seek(atS) {
    past.live();
    if (this.at !== null) Object.assign(this.at, { at_s: atS, receivedS: nowS() });
    command({ cmd: "play", at_s: atS });
  },

  speed(by) {
    if (this.at === null) return;
    const place = SPEEDS.findIndex((speed) => speed >= this.at.speed - 1e-6) + by;
    // At once here as well, so that a second key counts from it and not from what the program last stated.
    this.at.speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, place))];
    command({ cmd: "play", speed: this.at.speed });
  },

  paint() {
    show(byId("replay"), this.at !== null);
    if (this.at === null) return;
    const slider = byId("place");
    slider.max = String(this.at.length_s);
    if (!this.dragged) slider.value = String(this.placeS());
    const rounds = this.at.rounds > 0 ? `, round ${this.at.rounds + 1}` : "";
    say(byId("place-text"), `${number(this.dragged ? Number(slider.value) : this.placeS(), 1)} of ${number(this.at.length_s, 1)}${THIN}s${rounds}`);
    say(byId("play"), this.at.paused ? "Play" : "Hold");
    say(byId("speed"), `${short(this.at.speed)}\u00d7`);
    for (const id of ["place", "play", "slower", "faster"]) byId(id).disabled = !page.link.up;
  },
};
