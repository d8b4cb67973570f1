// Colour scale from `--heat-0` to `--heat-3`, the same in every picture.

const SHADES = 33;
const NAMES = ["--heat-0", "--heat-1", "--heat-2", "--heat-3"];

const partsOf = (hex) => [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));

/** Return true if black is readable on a colour (relative luminance of WCAG). */
function isLight(parts) {
  const [r, g, b] = parts.map((part) => part / 255).map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.18;
}

/**
 * Return the colours of the scale.
 * @param {Element} element whose style has the colours
 * @returns {{fill: string, ink: string}[]} from 0 to full scale: fill and text colour
 */
export function shadesOf(element) {
  const style = getComputedStyle(element);
  const stops = NAMES.map((name) => partsOf(style.getPropertyValue(name).trim()));
  return Array.from({ length: SHADES }, (_, i) => {
    const at = (i / (SHADES - 1)) * (stops.length - 1);
    const k = Math.min(stops.length - 2, Math.floor(at));
    const parts = stops[k].map((part, j) => Math.round(part + (at - k) * (stops[k + 1][j] - part)));
    return { fill: `rgb(${parts.join(" ")})`, ink: isLight(parts) ? "#000" : "#fff" };
  });
}

/** Return the shade of a share, clamped to 0 to 1. */
export const shadeOf = (shades, share) => shades[Math.round(Math.min(1, Math.max(0, share)) * (shades.length - 1))];
