// Small helpers for text and elements. All text from the server goes through textContent.

/**
 * The element of this id, which has to be there, and of this kind.
 * @overload
 * @param {string} id
 * @returns {HTMLElement}
 */
/**
 * @template {Element} E
 * @overload
 * @param {string} id
 * @param {new () => E} kind
 * @returns {E}
 */
/** @param {string} id @param {new () => Element} [kind] */
export function byId(id, kind = HTMLElement) {
  const element = document.getElementById(id);
  if (!(element instanceof kind)) throw new TypeError(`This page has no ${kind.name} #${id}.`);
  return element;
}

/** Did it happen in something of this selector? A dialog keeps the focus for a moment after it has closed: ask for `dialog[open]`. @param {Event} event @param {string} selector */
export const isInside = ({ target }, selector) => target instanceof Element && target.closest(selector) !== null;

// Controls, formats (which turn the direction of text, or have no width) and halves of a character.
const UNPRINTABLE = /[\p{Cc}\p{Cf}\p{Cs}\u2028\u2029]/gu;
const BLANK = /[\t\n\r]/; // shown as a space
const JOINER = /[\u200c\u200d]/; // part of some scripts, and of emoji

/**
 * Text as it may be shown: what has no picture of its own is spelt out, as `\x1b` or `\u202e`. For every name and
 * text of people, on the page and on canvas; what is sent back to the server stays as it is.
 * @param {string} text
 */
export const printable = (text) => String(text).replace(UNPRINTABLE, (found, at) => {
  if (BLANK.test(found) || (JOINER.test(found) && text.charCodeAt(at - 1) > 127)) return found;
  const code = found.codePointAt(0);
  return code < 256 ? `\\x${code.toString(16).padStart(2, "0")}` : `\\u${code.toString(16).padStart(4, "0")}`;
});

const SHOWN_ATTRIBUTES = new Set(["aria-label", "label", "placeholder", "title"]);

/**
 * An element with class, text and children; never markup from a string.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {{cls?: string, text?: string | null, [attribute: string]: any}} [says]
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[T]}
 */
export function el(tag, { cls = "", text = null, ...attributes } = {}, ...children) {
  const element = document.createElement(tag);
  if (cls) element.className = cls;
  if (text !== null) element.textContent = printable(text);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, SHOWN_ATTRIBUTES.has(name) ? printable(value) : value);
  element.append(...children.map((child) => (typeof child === "string" ? printable(child) : child)));
  return element;
}

/**
 * Write only what changed: thirty messages a second must not touch the DOM in vain.
 * @param {Element} element
 * @param {string} text
 */
export function setText(element, text) {
  const shown = printable(text);
  if (element.textContent === shown) return;
  const only = element.childNodes.length === 1 ? element.firstChild : null;
  if (only instanceof Text && shown !== "") only.data = shown; // no new node per message
  else element.textContent = shown;
}

/** @param {HTMLElement | SVGElement} element @param {string} name @param {string} value */
export function setData(element, name, value) {
  if (element.dataset[name] !== value) element.dataset[name] = value;
}

const MINUS = "\u2212";

/**
 * A number with a fixed count of decimals; a true minus sign, and never "-0.0".
 * @param {number | null | undefined} value
 * @param {number} [decimals]
 */
export function number(value, decimals = 1) {
  if (!isFiniteNumber(value)) return "–";
  const text = value.toFixed(decimals);
  if (Number(text) === 0) return text.replace("-", "");
  return text.replace("-", MINUS);
}

/** A rate; tenths of many are of no use to anybody. @param {number} hz */
export const perSecond = (hz) => number(hz, hz < 100 ? 1 : 0);

/** @param {unknown} value @returns {value is number} */
const isFiniteNumber = (value) => Number.isFinite(value);

/** What a test reads: three decimals with an ASCII minus, or nothing. @param {number | null | undefined} value */
export const plain = (value) => (isFiniteNumber(value) ? value.toFixed(3) : "");

/** @param {number | null | undefined} seconds */
export function duration(seconds) {
  if (!isFiniteNumber(seconds)) return "–";
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  const whole = Math.floor(seconds);
  const hours = Math.floor(whole / 3600);
  const rest = `${two(Math.floor((whole % 3600) / 60))}:${two(whole % 60)}`;
  return hours ? `${hours}:${rest} h` : `${rest} min`;
}

/** "3 min", for ages that need no precision. @param {number} seconds */
export function roughly(seconds) {
  if (seconds < 90) return `${Math.max(0, Math.round(seconds))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 129600) return `${Math.round(seconds / 3600)} h`;
  return `${Math.round(seconds / 86400)} days`;
}

/** @param {number | null | undefined} count */
export function bytes(count) {
  if (!isFiniteNumber(count)) return "–";
  if (count < 1e3) return `${count} B`;
  if (count < 1e6) return `${(count / 1e3).toFixed(0)} kB`;
  return count < 1e9 ? `${(count / 1e6).toFixed(1)} MB` : `${(count / 1e9).toFixed(2)} GB`;
}

/** @param {number} n */
const two = (n) => String(n).padStart(2, "0");

/** Local time, sortable: what a robotics notebook has. @param {Date} date */
export function localTime(date) {
  return `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())} `
    + `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
}

/** Copy a text to the clipboard; false: the browser does not let us. Its newer way exists in secure contexts only. @param {string} text */
export function copyText(text) {
  const before = document.activeElement;
  const field = el("textarea", { cls: "unseen", "aria-label": "To be copied" });
  field.value = text;
  document.body.append(field);
  field.select();
  const copied = document.execCommand("copy");
  field.remove();
  if (before instanceof HTMLElement) before.focus();
  return copied;
}
