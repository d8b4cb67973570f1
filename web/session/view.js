// Which time of a session is shown: seconds after its first frame, always within it. Pure.

export const LEAST_S = 0.02; // some frames of any array

/** @typedef {{from: number, to: number}} View */

/** @returns {View} as near as can be to what was asked for */
export function clamped({ from, to }, durationS) {
  const all = Math.max(durationS, LEAST_S);
  const span = Math.min(all, Math.max(LEAST_S, to - from));
  const middle = (from + to) / 2;
  const begin = Math.min(all - span, Math.max(0, to - from < LEAST_S ? middle - span / 2 : from));
  return { from: begin, to: begin + span };
}

export const whole = (durationS) => clamped({ from: 0, to: durationS }, durationS);

export const isWhole = (view, durationS) => view.to - view.from >= Math.max(durationS, LEAST_S) * (1 - 1e-9);

/** `factor` below 1 shows less time; what is at `aboutS` stays where it is. */
export function zoomed(view, factor, aboutS, durationS) {
  const span = Math.max(LEAST_S, (view.to - view.from) * factor);
  const share = (aboutS - view.from) / (view.to - view.from);
  return clamped({ from: aboutS - share * span, to: aboutS + (1 - share) * span }, durationS);
}

export const moved = (view, byS, durationS) => clamped({ from: view.from + byS, to: view.to + byS }, durationS);

/** Some time with a little of what is before and behind it. */
export function around(fromS, toS, durationS) {
  const margin = Math.max(0.3 * (toS - fromS), 0.05);
  return clamped({ from: fromS - margin, to: toS + margin }, durationS);
}

/** The view that a link states; the whole session if it states none. */
export function fromLink(search, durationS) {
  const fields = new URLSearchParams(search);
  const number = (name, otherwise) => {
    const value = Number.parseFloat(fields.get(name) ?? "");
    return Number.isFinite(value) ? value : otherwise;
  };
  const [from, to] = [number("from", 0), number("to", durationS)];
  return from < to ? clamped({ from, to }, durationS) : whole(durationS);
}

/** The cursor that a link states; null if it states none. */
export function cursorFromLink(search, durationS) {
  const timeS = Number.parseFloat(new URLSearchParams(search).get("at") ?? "");
  return timeS >= 0 && timeS <= durationS ? timeS : null;
}

/**
 * "?from=1.25&to=2.5&at=1.5", or nothing for the whole session without a cursor; what else the address asks for stays.
 * The chosen stance is the one that the cursor is in.
 */
export function toLink(view, durationS, search = "", cursorS = null) {
  const fields = new URLSearchParams(search);
  fields.delete("from");
  fields.delete("to");
  fields.delete("at");
  const text = (value) => String(Number(value.toFixed(4)));
  if (!isWhole(view, durationS)) {
    fields.set("from", text(view.from));
    fields.set("to", text(view.to));
  }
  if (cursorS !== null) fields.set("at", text(cursorS));
  return String(fields) && `?${fields}`;
}
