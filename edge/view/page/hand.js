// ---- A hand: from four sensors on a grid of small fields, of which one at a time is opened ----

const HAND_SENSORS = 4;
const PAD_TEXT_PX = 40; // height of a pad's words

const hand = {
  pads: new Map(),
  opened: null, // name of the sensor that is shown in full

  shown() { return page.sensors.size >= HAND_SENSORS; },

  /** Return true if the sensor is shown in full. */
  shows(sensor) { return !this.shown() || this.opened === sensor.name; },

  /** Make a pad for each sensor, in their order on the page, and show those sensors in full that are to be. */
  arrange() {
    const grid = byId("hand");
    show(grid, this.shown());
    if (!page.sensors.has(this.opened)) this.opened = null;
    grid.dataset.opened = this.opened === null ? "no" : "yes";
    for (const [name, pad] of this.pads) if (!page.sensors.has(name)) { pad.remove(); this.pads.delete(name); }
    for (const root of byId("sensors").querySelectorAll(".sensor")) {
      const sensor = page.sensors.get(root.dataset.sensor);
      show(root, this.shows(sensor));
      if (this.shown()) grid.append(this.padOf(sensor));
      sensor.dirty = true;
    }
    this.fit();
    painter.ask();
  },

  padOf({ name }) {
    if (!this.pads.has(name)) {
      const pad = byId("pad").content.firstElementChild.cloneNode(true);
      pad.dataset.pad = name;
      say(pad.querySelector(".name"), name);
      pad.onclick = () => this.open(this.opened === name ? null : name);
      this.pads.set(name, pad);
    }
    const pad = this.pads.get(name);
    pad.setAttribute("aria-pressed", String(this.opened === name));
    return pad;
  },

  open(name) {
    this.opened = name;
    this.arrange();
    this.pads.get(name)?.scrollIntoView({ block: "nearest", inline: "center" });
  },

  /** Open the next pad, or the one before. */
  step(by) {
    if (!this.shown()) return;
    const names = [...byId("hand").children].map((pad) => pad.dataset.pad);
    const at = names.indexOf(this.opened);
    this.open(names[at < 0 ? (by > 0 ? 0 : names.length - 1) : (at + by + names.length) % names.length]);
  },

  /** While none is opened, make the pads as large as the window allows for all of them at once. */
  fit() {
    const grid = byId("hand");
    if (grid.hidden) return;
    const [width, height] = [document.body.clientWidth - 32, window.innerHeight - grid.getBoundingClientRect().top - window.scrollY - this.below()];
    let side = 0;
    for (let columns = 1; columns <= this.pads.size; columns++) {
      const rows = Math.ceil(this.pads.size / columns);
      side = Math.max(side, Math.min(width / columns - 8, height / rows - 8 - PAD_TEXT_PX));
    }
    grid.style.setProperty("--side", `${Math.floor(Math.max(side, 72))}px`);
  },

  /** Return the height that is taken below the pads: on a small screen, the commands. */
  below() { return getComputedStyle(byId("keys")).position === "fixed" ? byId("keys").offsetHeight + 12 : 20; },

  /** Paint the small field of a sensor; all of them have one scale, so that they can be compared. */
  paint(sensor) {
    const pad = this.pads.get(sensor.name);
    if (pad === undefined || !this.shown()) return;
    const [state, word] = sensor.word();
    pad.dataset.state = state;
    say(pad.querySelector(".state"), word);
    pad.classList.toggle("old", sensor.old());
    pad.classList.toggle("doubted", sensor.doubted());
    pad.classList.toggle("lost", state === "lost" || state === "silent");
    pad.querySelector(".link").dataset.up = sensor.comes() ? "yes" : "no";
    const doubt = sensor.doubted() ? `; ${sensor.verdict()}` : "";
    pad.setAttribute("aria-label", `sensor ${sensor.name}: ${word}${doubt}`);
    paintMap(pad.querySelector("canvas"), sensor.pattern, Math.max(...[...page.sensors.values()].map((one) => one.high())), PATTERN_COLOURS);
  },
};

addEventListener("resize", () => hand.fit());
