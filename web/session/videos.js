// Videos of a session: list, upload, removal; the chosen one is shown beside the plots.

import { ask } from "../common/dialogs.js";
import { notice, quietly } from "../common/notices.js";
import { byId, bytes, duration, el, number, perSecond, setText } from "../common/text.js";
import { AlignmentCard } from "./alignment_card.js";
import { FilmCard } from "./film_card.js";
import { Strip } from "./strip.js";
import { upload } from "./upload.js";
import * as videoApi from "./video_api.js";

/** Return what a film is, such as "1920 × 1080, 50.0 pictures/s, 12.4 s, h264, 34.0 MB". @param {Video} video */
function factsOf({ film, size_bytes: size }) {
  const captured = film.capture_rate_hz === null ? "" : film.rate_hz > film.play_rate_hz ? ", slow motion" : ", time lapse";
  const hidden = film.hidden_count ? `, trimmed (${film.hidden_count.toLocaleString("en-GB")} pictures hidden)` : "";
  return `${film.width_px} × ${film.height_px}, ${perSecond(film.rate_hz)} pictures/s${film.is_variable ? " (variable)" : ""}${captured}${hidden}, ${duration(film.duration_s)}, ${film.codec}, ${bytes(size)}`;
}

/** Section of the videos. */
export class Videos {
  /** @param {import("./plotted.js").Plotted} page */
  constructor(page) {
    this.page = page;
    /** @type {Video[]} */
    this.items = [];
    this.card = new FilmCard(page);
    this.alignment = new AlignmentCard(page, this.card, (video) => this.put(video));
    this.strip = new Strip(page, this.card);
    this.stopping = null; // of an upload
    byId("upload-abort").addEventListener("click", () => this.stopping?.abort());
    const file = byId("video-file", HTMLInputElement);
    const send = byId("video-send", HTMLButtonElement);
    const choose = () => { send.disabled = !file.files.length; };
    file.addEventListener("change", choose);
    choose();
    send.addEventListener("click", () => quietly(async () => {
      const rate = byId("capture-rate", HTMLInputElement);
      if (await this.add(file.files[0], rate.value.trim())) file.value = rate.value = "";
      choose();
    }));
    const box = byId("video-upload");
    box.addEventListener("dragover", (event) => event.preventDefault()); // else nothing can be dropped
    box.addEventListener("drop", (event) => {
      event.preventDefault();
      file.files = event.dataTransfer.files;
      choose();
    });
  }

  /** Show a list of videos, and one of them. @param {Video[]} items @param {string} [chosen] id; default: the first that is aligned */
  async show(items, chosen = items.find((video) => video.alignment)?.id ?? items[0]?.id) {
    this.items = items;
    const video = items.find(({ id }) => id === chosen) ?? null;
    byId("videos-list").replaceChildren(...items.map((one) => this.row(one, one === video)));
    this.strip.clear();
    const shown = this.card.show(video);
    this.alignment.show(); // at once: its pairs are of another film
    await shown;
  }

  /** Show a video in its present state, and choose it. @param {Video} video */
  put(video) {
    const others = this.items.filter(({ id }) => id !== video.id);
    return this.show([...others, video].sort((a, b) => a.added_t_ns - b.added_t_ns), video.id);
  }

  row(video, isChosen) {
    const state = video.alignment ? `aligned by ${video.alignment.method}` : "not aligned";
    const show = el("button", { type: "button", cls: "small", text: "Show", "aria-pressed": isChosen, "aria-label": `Show ${video.name}` });
    show.hidden = this.items.length < 2;
    show.addEventListener("click", () => quietly(() => this.show(this.items, video.id)));
    const remove = el("button", { type: "button", cls: "small requires-operator", text: "Remove …", "aria-label": `Remove ${video.name}` });
    remove.addEventListener("click", () => quietly(() => this.remove(video)));
    const download = el("a", { href: videoApi.filmAddress(this.page.session.id, video.id), download: "", text: "Download", "aria-label": `Download ${video.name}` });
    return el("li", {}, show, el("span", {}, el("strong", { text: video.name }), ` ${factsOf(video)}, `, el("em", { text: state })), download, remove);
  }

  async remove(video) {
    if (!await ask("Remove video", `“${video.name}” and its alignment are deleted from the server. The session's frames stay.`, "Remove")) return;
    await videoApi.removeVideo(this.page.session.id, video.id);
    notice(`Removed video “${video.name}”.`);
    await this.show(this.items.filter(({ id }) => id !== video.id));
  }

  /** Upload a file; resolve to false if it was aborted. @param {File} file @param {string} captureRateHz "": as the file says */
  async add(file, captureRateHz) {
    this.stopping = new AbortController();
    const box = byId("upload");
    const bar = byId("upload-progress", HTMLProgressElement);
    const say = (share) => {
      bar.value = share;
      setText(byId("upload-text"), share < 1 ? `${file.name}: ${number(100 * share, 0)} % of ${bytes(file.size)}` : `${file.name}: the server reads it`);
    };
    box.hidden = false;
    say(0);
    try {
      const video = await upload(videoApi.videosAddress(this.page.session.id, file.name, captureRateHz), file, say, this.stopping.signal);
      await this.put(video);
      notice(`Added video “${video.name}”.`);
      return true;
    } catch (error) {
      if (!this.stopping.signal.aborted) throw error;
      notice("Upload aborted; nothing was kept.");
      return false;
    } finally {
      box.hidden = true;
      this.stopping = null;
    }
  }
}
