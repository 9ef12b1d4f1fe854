// ---- Words and numbers ----

const THIN = "\u202f";
const MINUS = "\u2212";

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);
const number = (value, digits = 0) => value.toFixed(digits).replace(/^-(?=.*[1-9])/, MINUS).replace(/^-/, "");
const amount = (value, digits, unit) => (known(value) ? `${number(value, digits)}${THIN}${unit}` : "\u2013");
/** Return the largest value; Math.max would get more arguments than a call may have. */
function largest(values, least = 0) {
  let most = least;
  for (const value of values) if (value > most) most = value;
  return most;
}

const percent = (share) => amount(known(share) ? 100 * share : null, 1, "%");
const short = (value) => String(Number(value.toPrecision(3))).replace("-", MINUS);

/** Return the next larger number that is easy to read on a scale. */
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((factor) => factor * power >= value * (1 - 1e-9));
}

function duration(seconds) {
  if (!known(seconds)) return "unknown";
  if (seconds < 100) return `${Math.floor(seconds)}${THIN}s`;
  return seconds < 6000 ? `${Math.floor(seconds / 60)}${THIN}min` : `${Math.floor(seconds / 3600)}${THIN}h`;
}

const ago = (seconds) => (seconds < 1 ? "a moment ago" : `${duration(seconds)} ago`);

function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

const byId = (id) => document.getElementById(id);
const nowS = () => performance.now() / 1000;
const style = getComputedStyle(document.documentElement);
const colour = (name) => style.getPropertyValue(`--${name}`).trim();
