// Pointer, wheel, fingers and keys over the plots, as what they mean. Knows no data.

import { isInside } from "../common/text.js";

const CLICK_PX = 4;
const SIDEWAYS_PX = 8; // of a finger; upwards it scrolls the page
const DOUBLE_MS = 350;
const WHEEL_STEP = 0.0018;

/**
 * @typedef {object} Meaning
 * @property {(px: number, hovering?: boolean) => void} point the cursor is here
 * @property {(fromPx: number, toPx: number) => void} choosing a stretch is being chosen
 * @property {(fromPx: number, toPx: number) => void} choose it is chosen; equal: never mind
 * @property {(factor: number, px: number) => void} zoom
 * @property {(byPx: number) => void} move
 * @property {(px: number, py: number) => boolean} grab something is here that can be moved
 * @property {(px: number) => void} drag it is moved here
 * @property {(px: number | null) => void} drop it stays here; null: where it was
 * @property {() => void} all
 * @property {(event: KeyboardEvent) => boolean} key whether it meant something
 */

/** @param {HTMLElement} box @param {Meaning} means */
export function listen(box, means) {
  const down = new Map(); // pointers by id, where they are
  let fromPx = null; // of a stretch that is chosen with the mouse
  let lastTap = { atMs: -Infinity, px: 0 };
  let pinch = null;
  let touchedPx = null; // where a finger came down that may yet scroll the page
  let grabbedPx = null; // where something was taken hold of that can be moved
  const place = (event) => event.clientX - box.getBoundingClientRect().left;

  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    box.setPointerCapture(event.pointerId);
    down.set(event.pointerId, place(event));
    const py = event.clientY - box.getBoundingClientRect().top;
    if (down.size === 1 && means.grab(place(event), py)) {
      grabbedPx = place(event);
      return;
    }
    if (down.size === 2) {
      if (grabbedPx !== null) means.drop(null);
      grabbedPx = fromPx = touchedPx = null;
      pinch = spanOf(down);
    } else if (event.pointerType !== "mouse") touchedPx = place(event);
    else if (!event.shiftKey) fromPx = place(event);
    else means.point(place(event));
  });

  box.addEventListener("pointermove", (event) => {
    const px = place(event);
    const before = down.get(event.pointerId);
    if (before === undefined) {
      if (event.pointerType === "mouse") means.point(px, true);
      return;
    }
    down.set(event.pointerId, px);
    if (grabbedPx !== null) {
      if (Math.abs(px - grabbedPx) > CLICK_PX) means.drag(px);
      return;
    }
    if (pinch && down.size === 2) {
      const now = spanOf(down);
      means.move(pinch.middle - now.middle);
      means.zoom(pinch.width / now.width, now.middle);
      pinch = now;
    } else if (fromPx !== null) {
      means.point(px);
      if (Math.abs(px - fromPx) > CLICK_PX) means.choosing(fromPx, px);
    } else if (event.pointerType === "mouse") means.move(before - px);
    else if (!pinch && (touchedPx === null || Math.abs(px - touchedPx) > SIDEWAYS_PX)) {
      touchedPx = null;
      means.point(px);
    }
  });

  const up = (event) => {
    if (!down.has(event.pointerId)) return;
    const px = place(event);
    down.delete(event.pointerId);
    if (grabbedPx !== null) {
      const moved = event.type === "pointerup" && Math.abs(px - grabbedPx) > CLICK_PX;
      grabbedPx = null;
      means.drop(moved ? px : null);
      if (event.type === "pointerup" && !moved) means.point(px);
      return;
    }
    if (pinch) {
      if (!down.size) pinch = null; // the other finger has not become a cursor
      return;
    }
    const dragged = fromPx !== null && Math.abs(px - fromPx) > CLICK_PX;
    if (fromPx !== null) means.choose(fromPx, dragged && event.type === "pointerup" ? px : fromPx);
    fromPx = null;
    if (dragged || event.type !== "pointerup") return;
    const twice = event.timeStamp - lastTap.atMs < DOUBLE_MS && Math.abs(px - lastTap.px) < 24;
    lastTap = { atMs: twice ? -Infinity : event.timeStamp, px };
    if (twice) means.all();
    else means.point(px);
  };
  box.addEventListener("pointerup", up);
  box.addEventListener("pointercancel", up);

  box.addEventListener("wheel", (event) => {
    if (event.ctrlKey || Math.abs(event.deltaY) >= Math.abs(event.deltaX)) {
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
      // All is in view already: the wheel scrolls the page.
      if (event.deltaY > 0 && box.dataset.whole === "true" && !event.ctrlKey) return;
      means.zoom(Math.exp(event.deltaY * lines * WHEEL_STEP), place(event));
    } else means.move(event.deltaX);
    event.preventDefault();
  }, { passive: false });

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (isInside(event, "input, textarea, select, dialog[open]")) return;
    if (means.key(event)) event.preventDefault();
  });
}

function spanOf(pointers) {
  const [a, b] = [...pointers.values()];
  return { middle: (a + b) / 2, width: Math.max(20, Math.abs(a - b)) };
}
