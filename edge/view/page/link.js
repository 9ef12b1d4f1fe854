// ---- Settings kept between visits; a browser may refuse to store them ----

const memory = {
  get: (key) => { try { return localStorage.getItem(`edge-sr.${key}`); } catch { return null; } },
  set: (key, value) => { try { localStorage.setItem(`edge-sr.${key}`, value); } catch { /* the setting is lost at the next visit, no more */ } },
};

/** Return the token that opens the socket; it is stored for this tab's reloads and removed from the address bar. */
function takeToken() {
  const address = new URL(location.href);
  const given = address.searchParams.get("token");
  try {
    if (given === null) return sessionStorage.getItem("edge-sr.token");
    sessionStorage.setItem("edge-sr.token", given);
  } catch { /* without storage a reload needs the whole address again */ }
  if (given !== null) {
    address.searchParams.delete("token");
    history.replaceState(null, "", address);
  }
  return given;
}

// ---- Frames ----

/** Unpack a frame of the program (edge/sinks/binary_message.py): {header, maps by name}. */
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const maps = {};
  let at = 4 + length;
  for (const [name, shape] of header.maps ?? []) {
    const count = shape.reduce((product, size) => product * size, 1);
    maps[name] = { shape, values: new Float32Array(buffer, at, count) };
    at += 4 * count;
  }
  return { header, maps };
}

// ---- The link ----

const SILENT_S = 2.5; // the program sends a frame every second
const WAITS_S = [0.25, 0.5, 1, 2, 4];
const VERSION = 1;
const GOING_AWAY = 1001; // the run has ended
const REFUSED = [403, 503]; // access refused; too many viewers

class Link {
  constructor({ onFrame, onChange }) {
    Object.assign(this, { onFrame, onChange, socket: null, up: false, tries: 0, timer: 0, receivedS: nowS(), nextS: null, ended: false, why: null });
    const token = takeToken();
    this.path = token === null ? "/ws" : `/ws?token=${encodeURIComponent(token)}`;
  }

  open() {
    clearTimeout(this.timer);
    this.nextS = null;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${this.path}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => this.take(socket, data);
    socket.onclose = (event) => this.lose(socket, event.code);
    this.receivedS = nowS();
    this.socket = socket;
    this.onChange();
  }

  take(socket, data) {
    if (socket !== this.socket || typeof data === "string") return;
    this.receivedS = nowS();
    if (!this.up) {
      this.up = true; // set first, because the handler of the first frame may send an answer
      this.tries = 0;
      this.why = null;
      this.onChange();
    }
    this.onFrame(unpack(data), data);
  }

  lose(socket, code = null) {
    if (socket !== this.socket) return;
    socket.onmessage = socket.onclose = null;
    this.socket = null;
    if (this.up) this.ended = code === GOING_AWAY;
    else this.inquire();
    this.up = false;
    const wait = WAITS_S[Math.min(this.tries++, WAITS_S.length - 1)];
    this.nextS = nowS() + wait;
    this.timer = setTimeout(() => this.open(), 1000 * wait);
    this.onChange();
  }

  /** Ask for the reason of a refused socket by a plain request: a browser does not show it for a socket. */
  async inquire() {
    let why = null;
    try {
      const answer = await fetch(this.path, { signal: AbortSignal.timeout(1000 * SILENT_S) });
      if (REFUSED.includes(answer.status)) why = (await answer.text()).trim();
    } catch { /* no server answers */ }
    if (this.up || why === this.why) return;
    this.why = why;
    this.onChange();
  }

  /** Drop a silent socket: a program that sends nothing is gone, even if the socket still looks open. */
  look() {
    if (this.socket === null || nowS() - this.receivedS < SILENT_S) return;
    const socket = this.socket;
    this.lose(socket);
    socket.close();
  }

  hurry() {
    if (this.socket === null) this.open();
  }

  send(command) {
    if (!this.up) return false;
    this.socket.send(JSON.stringify(command));
    return true;
  }
}
