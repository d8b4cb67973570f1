// Alignment of a film: pairs of a picture and an instant of the session, or found by the server in its pictures.

import { ask } from "../common/dialogs.js";
import { notice, quietly } from "../common/notices.js";
import { byId, el, setText } from "../common/text.js";
import { pairOf } from "./film_time.js";
import { timeText } from "./overlay.js";
import * as videoApi from "./video_api.js";

const NOT_ALIGNED = "Not aligned: where this film lies in the session is not known. Align it here: by light or clock page if it shows one, else by hand.";

/** Controls and result of an alignment. While they are open, film and cursor move apart. */
export class AlignmentCard {
  /** @param {import("./plotted.js").Plotted} page @param {import("./film_card.js").FilmCard} card @param {(video: Video) => unknown} onVideo it has changed */
  constructor(page, card, onVideo) {
    this.page = page;
    this.card = card;
    this.onVideo = onVideo;
    this.pairs = [];
    this.shown = null; // id of the video that they are of
    const buttons = {
      "pair-hand": () => this.add("hand"), "pair-contact": () => this.add("contact"), "align-pairs": () => this.change((id, replace) => this.send(id, replace)),
      "align-light": () => this.find("light"), "align-clock": () => this.find("clock"),
      "align-undo": () => this.change((id) => videoApi.removeAlignment(this.page.session.id, id)),
    };
    for (const [name, act] of Object.entries(buttons)) byId(name).addEventListener("click", act);
    byId("alignment", HTMLDetailsElement).addEventListener("toggle", () => this.card.setApart(byId("alignment", HTMLDetailsElement).open));
  }

  /** Show the alignment of the card's video. */
  show() {
    const { line } = this.card;
    if (this.shown !== this.card.video?.id) this.pairs = [];
    this.shown = this.card.video?.id ?? null;
    setText(byId("alignment-line"), line?.text ?? NOT_ALIGNED);
    byId("align-undo").hidden = !line;
    this.draw();
  }

  /** Add the picture shown with the cursor, or with the contact nearest to the cursor. @param {"hand" | "contact"} method */
  add(method) {
    const { cursorS, plots, view } = this.page;
    const { film } = this.card;
    const contacts = plots.stances.filter((stance) => stance.begun && !stance.gap_s).map((stance) => stance.from);
    if (!film.times.length) return notice("this browser does not show the film.", { bad: true });
    if (!this.card.isCertain) return notice("which picture this browser shows is not known: see below the film.", { bad: true });
    if (!film.isStill) return notice("the film is moving: pause it.", { bad: true });
    if (cursorS === null) return notice(`put the cursor ${method === "hand" ? "on the instant" : "near the contact"} first.`, { bad: true });
    if (method === "contact" && film.wanted === 0) return notice("no picture before this one shows the foot in the air.", { bad: true });
    if (method === "contact" && !contacts.length) return notice("the session has no contact without gaps that begins in it.", { bad: true });
    const timeS = method === "hand" ? cursorS : contacts.reduce((best, one) => (Math.abs(one - cursorS) < Math.abs(best - cursorS) ? one : best));
    const resolutionS = method === "hand" ? (view.to - view.from) / plots.plotWidth : 1 / plots.whole.rateHz;
    this.pairs = this.pairs.filter(({ index }) => index !== film.wanted);
    this.pairs.push({ index: film.wanted, timeS, method, ...pairOf(method, film.times, film.wanted, timeS, plots.whole.beginNs, resolutionS) });
    this.draw();
  }

  draw() {
    byId("pairs").replaceChildren(...this.pairs.map((pair) => {
      const text = `Picture ${(pair.index + 1).toLocaleString("en-GB")} ↔ ${pair.method === "contact" ? "contact at " : ""}${timeText(pair.timeS, 1e-3)}`;
      const remove = el("button", { type: "button", cls: "small", text: "×", "aria-label": `Remove ${text}` });
      remove.addEventListener("click", () => { this.pairs = this.pairs.filter((one) => one !== pair); this.draw(); });
      return el("li", { text }, remove);
    }));
    byId("align-pairs", HTMLButtonElement).disabled = !this.pairs.length;
  }

  send(id, replace) {
    const pairs = this.pairs.map(({ film_s, t_ns, sigma_ns }) => ({ film_s, t_ns, sigma_ns }));
    const method = this.pairs.every((pair) => pair.method === "contact") ? "contact" : "hand";
    return videoApi.setAlignment(this.page.session.id, id, { method, pairs }, replace);
  }

  /** Let the server look for instants in the pictures. @param {"light" | "clock"} method */
  find(method) {
    const startedMs = performance.now();
    const say = () => setText(byId("align-wait"), `The server looks through the film: ${Math.round((performance.now() - startedMs) / 1e3)} s`);
    say();
    const timer = setInterval(say, 1000);
    this.change((id, replace) => videoApi.findAlignment(this.page.session.id, id, method, replace)).finally(() => {
      clearInterval(timer);
      setText(byId("align-wait"), "");
    });
  }

  /** Change the alignment, one that contradicts it only if that is confirmed; buttons wait meanwhile. @param {(id: string, replace: boolean) => Promise<Video>} asked */
  change(asked) {
    const tools = byId("alignment-tools", HTMLFieldSetElement);
    const { video: { id }, line } = this.card; // another film may be shown meanwhile
    tools.disabled = true;
    return quietly(async () => {
      const video = await asked(id, false).catch(async (error) => {
        if (error.status !== 409 || !line || !await ask("Replace alignment", error.message, "Replace")) throw error;
        return asked(id, true);
      });
      await this.onVideo(video);
      notice(this.card.line?.text ?? `“${video.name}” is no longer aligned.`);
    }).finally(() => { tools.disabled = false; });
  }
}
