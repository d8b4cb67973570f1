// Pointer, wheel, touch and keys over the plots, translated to actions. Independent of data.

import { isShortcut } from "../common/text.js";

const CLICK_PX = 4;
const SIDEWAYS_PX = 8; // of a finger; vertical motion scrolls the page
const DOUBLE_MS = 350;
const WHEEL_STEP = 0.0018;

/**
 * @typedef {object} GestureActions
 * @property {(px: number, hovering?: boolean) => void} point move the cursor
 * @property {(px: number) => void} tap move the cursor and select what is there
 * @property {(fromPx: number, toPx: number) => void} choosing a range is being selected
 * @property {(fromPx: number, toPx: number) => void} choose select the range; equal: cancel
 * @property {(factor: number, px: number) => void} zoom
 * @property {(byPx: number) => void} move
 * @property {(px: number, py: number) => boolean} grab return true if there is a marker to drag
 * @property {(px: number) => void} drag move the marker
 * @property {(px: number | null) => void} drop end the drag; null: cancel
 * @property {() => void} all
 * @property {(event: KeyboardEvent) => boolean} key return true if handled
 */

/** Bind all gestures. @param {HTMLElement} box @param {GestureActions} actions */
export function bindGestures(box, actions) {
  const down = new Map(); // pointer id -> x
  let fromPx = null; // start of a range selected by mouse
  let lastTap = { atMs: -Infinity, px: 0 };
  let pinch = null;
  let touchedPx = null; // touch that may still scroll the page
  let grabbedPx = null; // start of a drag
  const place = (event) => event.clientX - box.getBoundingClientRect().left;

  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    box.setPointerCapture(event.pointerId);
    down.set(event.pointerId, place(event));
    const py = event.clientY - box.getBoundingClientRect().top;
    if (down.size === 1 && actions.grab(place(event), py)) {
      grabbedPx = place(event);
      return;
    }
    if (down.size === 2) {
      if (grabbedPx !== null) actions.drop(null);
      grabbedPx = fromPx = touchedPx = null;
      pinch = spanOf(down);
    } else if (event.pointerType !== "mouse") touchedPx = place(event);
    else if (!event.shiftKey) fromPx = place(event);
    else actions.point(place(event));
  });

  box.addEventListener("pointermove", (event) => {
    const px = place(event);
    const before = down.get(event.pointerId);
    if (before === undefined) {
      if (event.pointerType === "mouse") actions.point(px, true);
      return;
    }
    down.set(event.pointerId, px);
    if (grabbedPx !== null) {
      if (Math.abs(px - grabbedPx) > CLICK_PX) actions.drag(px);
      return;
    }
    if (pinch && down.size === 2) {
      const now = spanOf(down);
      actions.move(pinch.middle - now.middle);
      actions.zoom(pinch.width / now.width, now.middle);
      pinch = now;
    } else if (fromPx !== null) {
      actions.point(px);
      if (Math.abs(px - fromPx) > CLICK_PX) actions.choosing(fromPx, px);
    } else if (event.pointerType === "mouse") actions.move(before - px);
    else if (!pinch && (touchedPx === null || Math.abs(px - touchedPx) > SIDEWAYS_PX)) {
      touchedPx = null;
      actions.point(px);
    }
  });

  const up = (event) => {
    if (!down.has(event.pointerId)) return;
    const px = place(event);
    down.delete(event.pointerId);
    if (grabbedPx !== null) {
      const moved = event.type === "pointerup" && Math.abs(px - grabbedPx) > CLICK_PX;
      grabbedPx = null;
      actions.drop(moved ? px : null);
      if (event.type === "pointerup" && !moved) actions.point(px);
      return;
    }
    if (pinch) {
      if (!down.size) pinch = null; // the remaining finger is no cursor
      return;
    }
    const still = fromPx !== null || touchedPx !== null; // neither panned nor moved the cursor
    const dragged = fromPx !== null && Math.abs(px - fromPx) > CLICK_PX;
    if (fromPx !== null) actions.choose(fromPx, dragged && event.type === "pointerup" ? px : fromPx);
    fromPx = null;
    if (dragged || event.type !== "pointerup") return;
    const twice = event.timeStamp - lastTap.atMs < DOUBLE_MS && Math.abs(px - lastTap.px) < 24;
    lastTap = { atMs: twice ? -Infinity : event.timeStamp, px };
    if (twice) actions.all();
    else if (still) actions.tap(px);
    else actions.point(px);
  };
  box.addEventListener("pointerup", up);
  box.addEventListener("pointercancel", up);

  box.addEventListener("wheel", (event) => {
    if (event.ctrlKey || event.metaKey) { // a trackpad's pinch has ctrlKey
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
      actions.zoom(Math.exp(event.deltaY * lines * WHEEL_STEP), place(event));
    } else if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) actions.move(event.deltaX);
    else return; // scrolls the page
    event.preventDefault();
  }, { passive: false });

  addEventListener("keydown", (event) => {
    if (isShortcut(event) && actions.key(event)) event.preventDefault();
  });
}

function spanOf(pointers) {
  const [a, b] = [...pointers.values()];
  return { middle: (a + b) / 2, width: Math.max(20, Math.abs(a - b)) };
}
