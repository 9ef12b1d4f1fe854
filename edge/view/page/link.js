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

/** Unpack a frame of the program (edge/sinks/json_records.py): {header, maps by name}. */
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

class Link {
  constructor({ onFrame, onChange }) {
    Object.assign(this, { onFrame, onChange, socket: null, up: false, tries: 0, timer: 0, receivedS: nowS(), nextS: null, ended: false, why: null });
    // Beside the page, which a proxy may serve below a path.
    this.url = new URL(`${location.pathname.replace(/\/?$/, "/")}ws`, location.href);
    const token = takeToken();
    if (token !== null) this.url.searchParams.set("token", token);
  }

  open() {
    clearTimeout(this.timer);
    this.nextS = null;
    const address = new URL(this.url);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => this.take(socket, data);
    socket.onclose = ({ code, reason }) => this.lose(socket, code, reason);
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
    this.onFrame(unpack(data));
  }

  lose(socket, code = null, reason = null) {
    if (socket !== this.socket) return;
    socket.onmessage = socket.onclose = null;
    this.socket = null;
    if (this.up) this.ended = code === 1001; // "going away": the run has ended
    else if (code === 1013) this.why = reason; // "try again later": too many viewers
    else this.inquire();
    this.up = false;
    const wait = WAITS_S[Math.min(this.tries++, WAITS_S.length - 1)];
    this.nextS = nowS() + wait;
    this.timer = setTimeout(() => this.open(), 1000 * wait);
    this.onChange();
  }

  /** Ask for the reason of a refused socket by a plain request: a browser does not show it for a socket. */
  async inquire() {
    const address = new URL(this.url);
    address.searchParams.set("origin", location.origin); // which a browser sends for a socket alone
    let why = null;
    try {
      const answer = await fetch(address, { signal: AbortSignal.timeout(1000 * SILENT_S) });
      const plain = answer.headers.get("Content-Type")?.startsWith("text/plain");
      if (answer.status === 403 && plain) why = (await answer.text()).trim(); // access is refused
      else if (answer.status !== 426) why = `${location.host} answers ${answer.status} for ${address.pathname}, and not edge-sr`;
      // A plain request is answered by 426 where a socket is granted. One lost may be chance, as where the program has just begun.
      else if (this.tries >= 3) why = "something between does not pass the socket on: a proxy must send HTTP/1.1 with the headers Upgrade and Connection";
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
