// ---- Painting: only changes, only while the page is visible ----

const painter = {
  asked: 0,
  ask() {
    if (this.asked === 0 && !document.hidden) this.asked = requestAnimationFrame(() => this.paint());
  },
  all() {
    for (const sensor of page.sensors.values()) sensor.dirty = true;
    page.map.dirty = true;
    this.ask();
  },
  /** Paint at once: a canvas of a new size is blank. */
  resized() {
    for (const sensor of page.sensors.values()) sensor.paint();
    page.map.paintPads();
  },
  paint() {
    this.asked = 0;
    paintPage();
    for (const sensor of page.sensors.values()) if (sensor.dirty) sensor.paint();
    if (page.map.dirty) page.map.paint();
  },
};

// ---- The page ----

const REFUSAL_S = 10; // time for which a refusal is shown, and may be forced

const page = {
  hello: null,
  sensors: new Map(),
  map: new MapPane(),
  state: {},
  eventNumber: 0, // number of the run's latest event that is in the log
  shear: false,
  spanS: 10,
  asked: null, // latest request of this page to zero: {sensor, or undefined for all; untilS}
  forcible: new Set(), // sensors whose zeroing was refused, while it may be forced
  refusalTimer: 0,
  lostS: null,
  link: null,
};

function announce(text) { say(byId("live"), text); }

/** Add a line, in place of one of the same key, which is counted: only its numbers may differ. */
function log(what, { key = what, bad = false, ageS = 0 } = {}) {
  const list = byId("log");
  const clock = new Date(Date.now() - 1000 * ageS).toLocaleTimeString();
  list.querySelector(".none")?.remove();
  const before = [...list.children].find((line) => line.dataset.key === key);
  before?.remove();
  const line = document.createElement("li");
  const times = 1 + Number(before?.dataset.times ?? 0);
  Object.assign(line.dataset, { key, times });
  for (const [tag, text] of [["time", clock], ["span", what], ["span", times > 1 ? `${times} times` : ""]]) line.appendChild(document.createElement(tag)).textContent = text;
  line.querySelector("span").classList.toggle("bad", bad);
  list.prepend(line);
  while (list.children.length > 100) list.lastChild.remove();
  if (bad) announce(what);
}

function paintPage() {
  const { hello, link } = page;
  const origin = byId("origin");
  const source = hello?.source ?? "device";
  show(origin, hello !== null && source !== "device");
  origin.dataset.source = source;
  say(origin, source === "replay" ? `REPLAY: a recording, not live data${placeText()}` : "EMULATED: these are not data of a sensor");
  const models = new Set([...page.sensors.values()].map((sensor) => sensor.result?.model ?? hello.model));
  const about = byId("about");
  const modelNames = [...(models.size ? models : hello === null ? [] : [hello.model])];
  say(about, hello === null ? "" : [shortName(hello.name), ...modelNames].join(", "));
  if (hello !== null) about.title = [hello.name, ...modelNames].join(", ");
  paintTrouble();
  for (const id of ["zero", "reset", "force"]) byId(id).disabled = !link.up;
  show(byId("waiting"), page.sensors.size === 0);
  say(byId("waiting"), `Waiting for ${hello === null ? "edge-sr" : "the first scan"}`);
  document.title = titleText(source);
}

function paintTrouble() {
  const { link } = page;
  const [trouble, state] = [byId("trouble"), byId("link")];
  const waitS = link.nextS === null ? 0 : Math.max(0, Math.ceil(link.nextS - nowS()));
  const next = waitS > 0 ? `next try in ${waitS}${THIN}s` : "trying again";
  const silent = [...page.sensors.values()].filter((sensor) => sensor.silentS !== null);
  state.dataset.up = link.up ? (silent.length > 0 ? "part" : "yes") : "no";
  const viewers = page.state.viewers > 1 ? `, ${page.state.viewers} viewers` : "";
  say(state, link.up ? `connected${viewers}${silent.length > 0 ? `; no scan from ${silent.map((sensor) => sensor.name).join(", ")}` : ""}` : page.hello === null && link.tries === 0 ? "connecting" : "not connected");
  const lost = !link.up && link.tries > 0;
  show(trouble, lost);
  const since = ago(nowS() - page.lostS);
  const what = page.hello === null ? "no connection to edge-sr" : `${link.ended ? `the run has ended (${since})` : `connection lost ${since}`}: the values shown are old`;
  if (lost) say(trouble, [what, link.why, next].filter((text) => text !== null).join("; "));
}

/** Return how far the recording is that is played. */
function placeText() {
  const lengthS = page.hello.length_s;
  const atS = Math.max(0, ...[...page.sensors.values()].map((sensor) => sensor.trace.newestS));
  return known(lengthS) ? `, ${number(Math.min(atS, lengthS), 1)} of ${number(lengthS, 1)}${THIN}s` : "";
}

const lostWord = () => (page.link.ended ? "run ended" : "connection lost");

/** Return the name of a source with files by their names alone. */
const shortName = (name) => name.replace(/(?<=[:,])[^,:]*\/(?=[^/,]+\.(?:csv|npz|mcap)\b)/g, "");

function titleText(source) {
  const mark = source === "device" ? "" : `${source.toUpperCase()} `;
  const words = [...page.sensors.values()].map((sensor) => sensor.word()[0]);
  return `${mark}${page.link.up ? [...new Set(words)].join(", ") || "waiting" : lostWord()} \u2013 edge-sr`;
}

// ---- Frames from the program ----

const frameHandlers = {
  hello(header) {
    if (page.hello !== null && page.hello.run !== header.run) forgetRun();
    page.hello = header;
    document.documentElement.style.setProperty("--pad", `${header.cols} / ${header.rows}`);
  },
  result(header, maps) {
    if (page.hello !== null) sensorOf(header.sensor).take(header, maps);
  },
  map(header, maps) {
    page.map.take(header, maps);
  },
  event({ note, event, sensor, number, age_s = 0 }) {
    if (number <= page.eventNumber) return; // a new connection, also a reconnect, gets the latest events again
    page.eventNumber = number ?? page.eventNumber; // the answer to this page alone has no number
    const refused = ["refused", "in_contact", "given_up"].includes(event);
    const byNumbers = ["reset", "zeroing", "in_contact", "given_up", "rest_level", "baseline_doubted", "baseline_cleared"]; // differ by them alone
    const key = byNumbers.includes(event) ? `${event} ${sensor}` : note;
    log(note, { key, bad: refused || ["lost", "silent", "trouble", "sink", "suspected", "baseline_doubted"].includes(event), ageS: age_s });
    if (refused && age_s < REFUSAL_S) refuse(note, event === "in_contact" ? sensor : null);
  },
  state(header) {
    page.state = header;
    if (page.hello === null) return;
    for (const [name, sensor] of page.sensors) {
      const silentS = header.silent?.[name] ?? null;
      if (silentS !== null || sensor.silentS !== null) sensor.dirty = true;
      sensor.silentS = silentS;
    }
  },
};

/** Show a refusal where it is seen at once; if a touched sensor is the reason, this page may force its own request, by another button and for a limited time. */
function refuse(text, touchedSensor) {
  const { asked, forcible } = page;
  if (touchedSensor !== null && asked !== null && nowS() < asked.untilS && (asked.sensor ?? touchedSensor) === touchedSensor) forcible.add(touchedSensor);
  else if (forcible.size > 0) return; // the user has to decide on the refusal shown; the log has this one, too
  clearTimeout(page.refusalTimer);
  page.refusalTimer = setTimeout(forgetRefusal, 1000 * REFUSAL_S);
  const touched = [...forcible].map((name) => `sensor ${name} is in contact`);
  say(byId("refusal").firstElementChild, touched.length > 0 ? `zeroing refused: ${touched.join(", ")}` : text);
  show(byId("force"), touched.length > 0);
  show(byId("refusal"), true);
}

function forgetRefusal() {
  clearTimeout(page.refusalTimer);
  page.asked = null;
  page.forcible.clear();
  show(byId("refusal"), false);
}

function sensorOf(name) {
  if (!page.sensors.has(name)) {
    const later = [...page.sensors.values()].filter((other) => other.name.localeCompare(name, "en", { numeric: true }) > 0);
    const sensor = new Sensor(name);
    const next = [...byId("sensors").children].find((root) => later.some((other) => other.root === root));
    byId("sensors").insertBefore(sensor.root, next ?? null);
    page.sensors.set(name, sensor);
    painter.all();
  }
  return page.sensors.get(name);
}

/** Forget the sensors and the events of a run: they do not belong to the next. */
function forgetRun() {
  for (const sensor of page.sensors.values()) sensor.remove();
  page.sensors.clear();
  page.map.forget();
  page.eventNumber = 0;
  forgetRefusal();
  log("a new run has begun");
}

// ---- Commands ----

function command(what) {
  const sent = page.link.send(what);
  if (!sent) log("command not sent: no connection to edge-sr", { bad: true });
  return sent;
}

const act = {
  zero(sensor) {
    forgetRefusal();
    if (command({ cmd: "zero", sensor })) page.asked = { sensor, untilS: nowS() + REFUSAL_S };
  },
  force() {
    for (const sensor of page.forcible) command({ cmd: "zero", sensor, force: true });
    forgetRefusal();
  },
  reset() { command({ cmd: "reset" }); },
  shear() {
    page.shear = !page.shear;
    painter.all();
  },
  span() {
    page.spanS = page.spanS === 10 ? 60 : 10;
    painter.all();
  },
  help() { if (!byId("manual").open) byId("manual").showModal(); },
};

const KEYS = { z: "zero", "shift z": "force", r: "reset", t: "span", "?": "help" };

function pressed(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat || document.querySelector("dialog[open]")) return;
  const letter = event.key.toLowerCase(); // independent of Caps Lock
  const action = KEYS[event.shiftKey && /[a-z]/.test(letter) ? `shift ${letter}` : letter];
  if (action === undefined) return;
  event.preventDefault();
  act[action]();
}

// ---- Start ----

page.link = new Link({
  onFrame({ header, maps }) {
    frameHandlers[header.kind]?.(header, maps);
    painter.ask();
  },
  onChange() {
    const { link } = page;
    if (link.tries === 1 && !link.up && page.hello !== null && link.nextS !== null) {
      page.lostS = link.receivedS;
      announce(lostWord());
    }
    if (link.why !== null) announce(link.why);
    if (link.up && page.lostS !== null) {
      log(`connected again after ${duration(nowS() - page.lostS)}`);
      page.lostS = null;
    }
    painter.all();
  },
});

for (const id of ["zero", "force", "reset", "help"]) byId(id).onclick = () => act[id]();
document.addEventListener("keydown", pressed);
document.addEventListener("visibilitychange", () => { page.link.hurry(); painter.all(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => painter.all());
// Only ages and waits change without a new frame.
setInterval(() => {
  page.link.look();
  const moving = !page.link.up || [...page.sensors.values()].some((sensor) => !sensor.live());
  if (moving) painter.all();
}, 500);
page.link.open();
