// Visible range of a session, seconds after its first frame. Pure.

export const LEAST_S = 0.02; // a few frames

/** @typedef {{from: number, to: number}} View */

/** Return the nearest valid view. @returns {View} */
export function clamped({ from, to }, durationS) {
  const all = Math.max(durationS, LEAST_S);
  const span = Math.min(all, Math.max(LEAST_S, to - from));
  const middle = (from + to) / 2;
  const begin = Math.min(all - span, Math.max(0, to - from < LEAST_S ? middle - span / 2 : from));
  return { from: begin, to: begin + span };
}

export const whole = (durationS) => clamped({ from: 0, to: durationS }, durationS);

export const isWhole = (view, durationS) => view.to - view.from >= Math.max(durationS, LEAST_S) * (1 - 1e-9);

/** Return a zoomed view: `factor` below 1 shows less time, `aboutS` stays in place. */
export function zoomed(view, factor, aboutS, durationS) {
  const span = Math.max(LEAST_S, (view.to - view.from) * factor);
  const share = (aboutS - view.from) / (view.to - view.from);
  return clamped({ from: aboutS - share * span, to: aboutS + (1 - share) * span }, durationS);
}

export const moved = (view, byS, durationS) => clamped({ from: view.from + byS, to: view.to + byS }, durationS);

/** Return a view of an interval with a margin. */
export function around(fromS, toS, durationS) {
  const margin = Math.max(0.3 * (toS - fromS), 0.05);
  return clamped({ from: fromS - margin, to: toS + margin }, durationS);
}

/** Return the view of a URL; default: whole session. */
export function fromLink(search, durationS) {
  const fields = new URLSearchParams(search);
  const number = (name, otherwise) => {
    const value = Number.parseFloat(fields.get(name) ?? "");
    return Number.isFinite(value) ? value : otherwise;
  };
  const [from, to] = [number("from", 0), number("to", durationS)];
  return from < to ? clamped({ from, to }, durationS) : whole(durationS);
}

/** Return the cursor of a URL; null: none. */
export function cursorFromLink(search, durationS) {
  const timeS = Number.parseFloat(new URLSearchParams(search).get("at") ?? "");
  return timeS >= 0 && timeS <= durationS ? timeS : null;
}

/** Return the number of the selected stance of a URL; null: none. */
export function stanceFromLink(search) {
  const number = Number(new URLSearchParams(search).get("stance"));
  return Number.isInteger(number) && number > 0 ? number : null;
}

/** Return the query of a view, such as "?from=1.25&to=2.5&at=1.5&stance=3"; other fields of `search` stay. */
export function toLink(view, durationS, search = "", cursorS = null, stance = null) {
  const fields = new URLSearchParams(search);
  for (const name of ["from", "to", "at", "stance"]) fields.delete(name);
  const text = (value) => String(Number(value.toFixed(4)));
  if (!isWhole(view, durationS)) {
    fields.set("from", text(view.from));
    fields.set("to", text(view.to));
  }
  if (cursorS !== null) fields.set("at", text(cursorS));
  if (stance !== null) fields.set("stance", String(stance));
  return String(fields) && `?${fields}`;
}
