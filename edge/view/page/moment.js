// ---- A moment as a file: picture, table, arrays ----

const MOMENT_MAPS = [["pattern", "mm"], ["deviation", "mm"], ["zeroed", "counts"], ["taps", "counts"]];

/** Keep what a sensor shows now; null if it shows no scan. */
function momentOf(sensor) {
  if (sensor.result === null) return null;
  const { trace, maps: _, ...record } = sensor.made();
  const pattern = sensor.newest() || page.atS !== null ? sensor.pattern : null; // an old contact is no part of this moment
  const maps = { pattern, deviation: pattern === null ? null : sensor.deviation, zeroed: sensor.zeroed, taps: sensor.taps };
  return { record, maps: Object.entries(maps).filter(([, map]) => map !== null), source: record.source ?? page.hello.source };
}

function save(name, type, ...parts) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const fileName = ({ record, source }, ending) => `${source === "device" ? "" : `${source}-`}${record.sensor.replace(/[^\w-]+/g, "_")}-scan${record.scan}.${ending}`;

/** A table with a row for each value; the first line states what it is of. */
function saveCsv(moment) {
  const { record, maps, source } = moment;
  const units = Object.fromEntries(MOMENT_MAPS);
  const lines = [`# ${[`sensor ${record.sensor}`, `scan ${record.scan}`, `source ${source}`, `state ${record.state}`, `model ${record.model}`, `trusted ${record.trusted}`].join(", ")}`.replace(/[\r\n]/g, " "), "map,layer,row,col,value,unit"];
  for (const [name, { shape, values }] of maps) {
    const [rows, cols] = shape.slice(-2);
    values.forEach((value, at) => lines.push([name, Math.floor(at / (rows * cols)), Math.floor(at / cols) % rows, at % cols, Number.isNaN(value) ? "" : Number(value.toPrecision(7)), units[name]].join()));
  }
  save(fileName(moment, "csv"), "text/csv", `${lines.join("\n")}\n`);
}

/** Return an array as a .npy file: float32, or one text. */
function npy(values, shape) {
  const text = typeof values === "string";
  const points = text ? Uint32Array.from(values, (one) => one.codePointAt(0)) : values;
  const kind = text ? `<U${points.length}` : "<f4";
  const head = `{'descr': '${kind}', 'fortran_order': False, 'shape': (${text ? "" : `${shape.join(", ")},`}), }`;
  const padded = `${head}${" ".repeat((64 - ((10 + head.length + 1) % 64)) % 64)}\n`;
  const bytes = new Uint8Array(10 + padded.length + points.byteLength);
  bytes.set([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, padded.length & 255, padded.length >> 8]);
  bytes.set(new TextEncoder().encode(padded), 10);
  bytes.set(new Uint8Array(points.buffer, points.byteOffset, points.byteLength), 10 + padded.length);
  return bytes;
}

function crc32(bytes) {
  let crc = -1;
  for (const byte of bytes) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}

/** Return the parts of a zip archive without compression, as numpy writes and reads it. */
function zip(files) {
  const little = (...fields) => {
    const bytes = new DataView(new ArrayBuffer(fields.reduce((sum, [size]) => sum + size, 0)));
    let at = 0;
    for (const [size, value] of fields) { bytes[size === 4 ? "setUint32" : "setUint16"](at, value, true); at += size; }
    return new Uint8Array(bytes.buffer);
  };
  const [parts, directory] = [[], []];
  let at = 0;
  for (const [name, bytes] of files) {
    const title = new TextEncoder().encode(name);
    const facts = [[2, 20], [2, 0], [2, 0], [2, 0], [2, 33], [4, crc32(bytes)], [4, bytes.length], [4, bytes.length], [2, title.length], [2, 0]];
    const local = [little([4, 0x04034b50], ...facts), title, bytes];
    directory.push(little([4, 0x02014b50], [2, 20], ...facts, [2, 0], [2, 0], [2, 0], [4, 0], [4, at]), title);
    parts.push(...local);
    at += local.reduce((sum, part) => sum + part.length, 0);
  }
  const size = directory.reduce((sum, part) => sum + part.length, 0);
  return [...parts, ...directory, little([4, 0x06054b50], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, size], [4, at], [2, 0])];
}

function saveNpz(moment) {
  const arrays = moment.maps.map(([name, { values, shape }]) => [`${name}.npy`, npy(values, shape)]);
  save(fileName(moment, "npz"), "application/zip", ...zip([...arrays, ["record.npy", npy(JSON.stringify(moment.record))]]));
}

/** The pattern with its marks, its scale and the words that belong to it: also that it is not to be believed, or emulated. */
function savePng(sensor, moment) {
  if (sensor.dirty) sensor.paint(); // or the picture and its numbers would be of the scan before the one in its title
  const { record, source } = moment;
  const [edge, size] = [20, 640];
  const [rows, cols] = sensor.size();
  const tall = Math.round((size * rows) / cols);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [size + 2 * edge, tall + 150];
  const context = canvas.getContext("2d");
  context.fillStyle = "#fff";
  context.fillRect(0, 0, canvas.width, canvas.height);
  const there = moment.maps.some(([name]) => name === "pattern");
  context.imageSmoothingEnabled = false;
  context.fillStyle = "#ddd";
  context.fillRect(edge, 50, size, tall);
  if (there) context.drawImage(sensor.part.pattern, edge, 50, size, tall);
  if (there && sensor.part.over.width > 0) context.drawImage(sensor.part.over, edge, 50, size, tall); // of a hand only the opened pad has marks
  context.drawImage(sensor.part["pattern-bar"], edge, tall + 58, size, 12);
  context.fillStyle = "#16202b";
  context.font = '600 20px system-ui, "DejaVu Sans", sans-serif';
  const mark = source === "device" ? "" : `${source.toUpperCase()}: `;
  context.fillText(`${mark}sensor ${record.sensor}, scan ${record.scan}: ${record.state}`, edge, 34, size);
  context.font = '15px system-ui, "DejaVu Sans", sans-serif';
  const numbers = ["force", "area", "centroid_mm", "interval_mm"].map((key) => `${key.replace(/_mm$/, "")} ${sensor.fields[key].element.textContent}`);
  context.fillText(`0 to ${sensor.part["pattern-high"].textContent}; ${there ? sensor.part["pattern-most"].textContent : "no pattern"}`, edge, tall + 90, size);
  context.fillText(numbers.join(", "), edge, tall + 112, size);
  context.fillText(`model ${record.model}, ${new Date().toISOString()}`, edge, tall + 134, size);
  if (there && record.trusted === false) {
    context.fillStyle = "#a8231a";
    context.fillRect(edge, 50, size, 30);
    context.strokeStyle = "#a8231a";
    context.lineWidth = 8;
    context.strokeRect(edge + 4, 54, size - 8, tall - 8);
    context.fillStyle = "#fff";
    context.fillText(sensor.verdict() ?? "not to be believed", edge + 10, 71, size - 20);
  }
  canvas.toBlob((blob) => save(fileName(moment, "png"), "image/png", blob));
}

/** Save what each sensor showed when the dialog was opened: the page stands still meanwhile, or looks back. */
function saveMoment(ending) {
  for (const sensor of page.sensors.values()) {
    const moment = momentOf(sensor);
    if (moment === null) continue;
    if (!hand.shows(sensor)) sensor.paintWhole();
    if (ending === "png") savePng(sensor, moment);
    else (ending === "csv" ? saveCsv : saveNpz)(moment);
  }
}
