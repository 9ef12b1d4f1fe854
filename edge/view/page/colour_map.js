// ---- Colours: a few stops of maps that grow steadily lighter, and are readable for the colour-blind ----

const STOPS = {
  viridis: "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
  cividis: "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
  magma: "000004 180f3d 440f76 721f81 9e2f7f cd4071 f1605d fd9668 feca8d fcfdbf",
};
const LEVELS = 256;

/** Return 256 colours, as red, green and blue one after the other. */
function colourTable(name) {
  const stops = STOPS[name].split(" ").map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  const table = new Uint8ClampedArray(3 * LEVELS);
  for (let level = 0; level < LEVELS; level++) {
    const place = (level / (LEVELS - 1)) * (stops.length - 1);
    const lower = Math.min(Math.floor(place), stops.length - 2);
    for (let channel = 0; channel < 3; channel++) {
      const [from, to] = [stops[lower][channel], stops[lower + 1][channel]];
      table[3 * level + channel] = from + (to - from) * (place - lower);
    }
  }
  return table;
}

const VIRIDIS = colourTable("viridis");
const CIVIDIS = colourTable("cividis");
const MAGMA = colourTable("magma");

const level = (value, high) => Math.max(0, Math.min(LEVELS - 1, Math.round((value / high) * (LEVELS - 1))));

/** Paint one canvas pixel for each value; the style sheet enlarges the canvas. */
function paintMap(canvas, values, rows, cols, high, table) {
  if (canvas.width !== cols || canvas.height !== rows) [canvas.width, canvas.height] = [cols, rows];
  const context = canvas.getContext("2d");
  const image = context.createImageData(cols, rows);
  const { data } = image;
  for (let pixel = 0, to = 0; pixel < rows * cols; pixel++) {
    const at = 3 * level(values[pixel], high);
    data[to++] = table[at];
    data[to++] = table[at + 1];
    data[to++] = table[at + 2];
    data[to++] = 255;
  }
  context.putImageData(image, 0, 0);
}

const paintBar = (canvas, table) => paintMap(canvas, Float32Array.from({ length: LEVELS }, (_, at) => at), 1, LEVELS, LEVELS - 1, table);
