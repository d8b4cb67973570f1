// Helpers for text and elements. All text from the server goes through textContent.

/**
 * Return the element of an id and type; throw if there is none.
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

/** Return true if an event occurred inside a selector. A closed dialog keeps the focus for a moment: use `dialog[open]`. @param {Event} event @param {string} selector */
export const isInside = ({ target }, selector) => target instanceof Element && target.closest(selector) !== null;

/** Return true if a key is meant for the page: without modifiers, and not for a field or dialog. @param {KeyboardEvent} event */
export const isShortcut = (event) => !event.ctrlKey && !event.metaKey && !event.altKey
  && !isInside(event, "input, textarea, select, dialog[open], [contenteditable]");

// Control and format characters (direction, zero width) and lone surrogates.
const UNPRINTABLE = /[\p{Cc}\p{Cf}\p{Cs}\u2028\u2029]/gu;
const BLANK = /[\t\n\r]/; // shown as a space
const JOINER = /[\u200c\u200d]/; // part of some scripts, and of emoji

/**
 * Escape unprintable characters, as `\x1b` or `\u202e`. For all names and user texts on page and canvas, not for
 * text sent to the server.
 * @param {string} text
 */
export const printable = (text) => String(text).replace(UNPRINTABLE, (found, at) => {
  if (BLANK.test(found) || (JOINER.test(found) && text.charCodeAt(at - 1) > 127)) return found;
  const code = found.codePointAt(0);
  return code < 256 ? `\\x${code.toString(16).padStart(2, "0")}` : `\\u${code.toString(16).padStart(4, "0")}`;
});

const SHOWN_ATTRIBUTES = new Set(["aria-label", "label", "placeholder", "title"]);

/**
 * Make an element with class, text and children; never markup from a string.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {{cls?: string, text?: string | null, [attribute: string]: any}} [properties]
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
 * Set text if it has changed: thirty messages a second must not touch the DOM in vain.
 * @param {Element} element
 * @param {string} text
 */
export function setText(element, text) {
  const shown = printable(text);
  if (element.textContent === shown) return;
  const only = element.childNodes.length === 1 ? element.firstChild : null;
  if (only instanceof Text && shown !== "") only.data = shown; // keeps the text node
  else element.textContent = shown;
}

/** @param {HTMLElement | SVGElement} element @param {string} name @param {string} value */
export function setData(element, name, value) {
  if (element.dataset[name] !== value) element.dataset[name] = value;
}

const MINUS = "\u2212";

/**
 * Format a number with fixed decimals and a true minus sign, never "-0.0".
 * @param {number | null | undefined} value
 * @param {number} [decimals]
 */
export function number(value, decimals = 1) {
  if (!isFiniteNumber(value)) return "–";
  const text = value.toFixed(decimals);
  if (Number(text) === 0) return text.replace("-", "");
  return text.replace("-", MINUS);
}

/** Format a rate, with tenths below 100. @param {number} hz */
export const perSecond = (hz) => number(hz, hz < 100 ? 1 : 0);

/** @param {unknown} value @returns {value is number} */
const isFiniteNumber = (value) => Number.isFinite(value);

/** Format for tests: three decimals, ASCII minus, or "". @param {number | null | undefined} value */
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

/** Format an age roughly: "3 min". @param {number} seconds */
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

/** How a tare was taken, by its `source`. @type {Record<string, string>} */
export const TARE_SOURCES = { unloaded: "by hand", recognised: "automatically, in the air", flight: "automatically, in the air" };

/** Format local time, sortable. @param {Date} date */
export function localTime(date) {
  return `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())} `
    + `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
}

/** Copy text to the clipboard; return false if blocked. The newer API exists in secure contexts only. @param {string} text */
export function copyText(text) {
  const before = document.activeElement;
  const field = el("textarea", { cls: "unseen", "aria-label": "Text to copy" });
  field.value = text;
  document.body.append(field);
  field.select();
  const copied = document.execCommand("copy");
  field.remove();
  if (before instanceof HTMLElement) before.focus();
  return copied;
}
