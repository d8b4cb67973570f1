// SVG elements and attributes.

import { printable } from "./text.js";

const SVG = "http://www.w3.org/2000/svg";

/**
 * Make an SVG element.
 * @template {keyof SVGElementTagNameMap} T
 * @param {T} tag
 * @param {Record<string, string | number>} [attributes]
 * @param {string | null} [text]
 * @returns {SVGElementTagNameMap[T]}
 */
export function svg(tag, attributes = {}, text = null) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  if (text !== null) element.textContent = printable(text);
  return element;
}

/** Set attributes that have changed. @param {Element} element @param {Record<string, string | number>} attributes */
export function place(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    const text = typeof value === "number" ? value.toFixed(2) : value;
    if (element.getAttribute(name) !== text) element.setAttribute(name, text);
  }
}
