// Menu of this device: screen, sound, vibration, and further entries of the page.

import { Absence } from "./absence.js";
import { Alerts } from "./alerts.js";
import { Awake } from "./awake.js";
import { menuButton } from "./menu.js";
import { notice, withdraw } from "./notices.js";
import { byId, el, setText } from "./text.js";

const ABOUT = "awake";

/**
 * Add the menu to the header; return what watches the link's messages.
 * @param {import("./trials.js").Trials} trials
 * @returns {((message: PageMessage) => void)[]}
 */
export function addDeviceMenu(trials) {
  const absence = new Absence();
  let wasDark = false;
  const alerts = new Alerts(absence);
  const screen = item("Keep screen on", () => awake.choose(!awake.chosen));
  const sound = item("Sound at alerts", () => alerts.choose("sound", !alerts.on.sound));
  const vibration = item("Vibration at alerts", () => alerts.canVibrate && alerts.choose("vibration", !alerts.on.vibration));
  const button = menuButton("Screen and alerts of this device", () => { draw(); return [screen, sound, vibration, trials.makeItem()]; });
  const awake = new Awake(draw);
  for (const one of [screen, sound, vibration]) one.addEventListener("click", () => draw());
  navigator.serviceWorker?.register("/worker.js").catch(() => {}); // in secure contexts, where the browser allows it
  button.id = "device";
  byId("sun").after(button);
  draw();
  return [alerts, absence, trials].map((one) => (message) => one.watch(message));

  function draw() {
    write(screen, awake.chosen, awake.state);
    write(sound, alerts.on.sound, alerts.soundState);
    write(vibration, alerts.on.vibration, !alerts.canVibrate ? "not on this device" : alerts.on.vibration ? "on" : "off");
    const isDark = awake.chosen && !awake.isHeld && Boolean(awake.reason);
    setText(button, isDark ? "⚠" : "⋯");
    if (isDark === wasDark) return;
    wasDark = isDark;
    if (isDark) notice(`The ${awake.state}.`, { stays: true, about: [ABOUT] });
    else withdraw(ABOUT);
  }
}

/** Make a switch of the menu, with its state below. */
function item(title, press) {
  const one = el("button", { type: "button", role: "menuitemcheckbox" }, el("span", { text: title }), el("small"));
  one.addEventListener("click", press);
  return one;
}

function write(one, isOn, state) {
  one.setAttribute("aria-checked", String(isOn));
  setText(one.querySelector("small"), state);
}
