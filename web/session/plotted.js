// View state of a session: visible range, cursor, and what depends on them.

import * as api from "../common/api.js";
import { isOperator } from "../common/login.js";
import { notice, quietly, showRefusal } from "../common/notices.js";
import { loadModule, unlessRefused } from "../common/request.js";
import { byId, copyText, isInside, setText } from "../common/text.js";
import { offsetAt } from "./clock.js";
import { axisText, moveClock, moveStances } from "./time_axis.js";
import { Downloads } from "./downloads.js";
import { bindGestures } from "./gestures.js";
import { drawLegend } from "./legend.js";
import { Loader } from "./load.js";
import { Markers } from "./markers.js";
import { Numbers } from "./numbers.js";
import { flagAt } from "./overlay.js";
import { savePicture } from "./picture.js";
import { Plots } from "./plots.js";
import { Readout, drawSummary } from "./readout.js";
import { Replay } from "./replay.js";
import { Stances, stanceAt, withSeconds } from "./stances.js";
import * as views from "./view.js";
import * as videoApi from "./video_api.js";

const KEY_ZOOM = 1.5;
const SETTLED_MS = 250;
const COLOURS_AT = 9; // index in the key of a drawing

/** Plots, cursor, markers, stances, replay and downloads of a session. */
export class Plotted {
  /** @param {SessionView} session @param {() => void} onArray runs once the tiles are loaded */
  constructor(session, onArray) {
    this.session = session;
    this.onArray = onArray;
    /** @type {import("./view.js").View | null} */
    this.view = null;
    this.plots = new Plots();
    this.plots.changed = () => this.draw();
    this.plots.name = `${session.name || session.id}, ${session.node}`;
    this.other = null; // session of the overlay
    this.readout = new Readout();
    this.numbers = new Numbers(session.id);
    this.stances = new Stances((index) => { this.goTo(index); this.stances.bringIntoView(); }, views.stanceFromLink(location.search));
    this.markers = new Markers(session.id, {
      go: (timeS) => this.goToMarker(timeS), cursor: () => this.cursorS,
      changed: () => { this.plots.markers = this.markers.placed; this.draw(); },
    });
    this.loader = new Loader(
      (query, stop) => api.overview(session.id, query, stop), (bins) => this.showDetail(bins), showRefusal);
    this.replay = new Replay({
      at: () => this.cursorS ?? this.view.from, go: (timeS) => this.cursorTo(timeS),
      range: () => (this.shownStance ? this.view : { from: 0, to: this.durationS }),
      changed: () => this.draw(), failed: showRefusal,
    });
    this.downloads = new Downloads();
    /** @type {import("./videos.js").Videos | null} */
    this.videos = null;
    this.cursorS = null;
    this.drawing = 0;
  }

  /** Load and draw; again while the session grows and once it is sealed. @param {SessionView} session */
  async load(session) {
    const first = !this.view;
    const sealed = session.state === "sealed";
    if (first) byId("plots-card").hidden = false; // its width sets the number of bins
    const whole = await this.loader.whole(byId("plots").clientWidth).catch((error) => {
      if (first) byId("plots-card").hidden = true;
      throw error;
    });
    const grown = this.session.marker_count !== session.marker_count || whole.estimated !== this.plots.whole?.estimated;
    this.session = session;
    this.showWhole(whole);
    if (first) {
      this.listen();
      const offer = () => { this.downloads.offer(this.plots.whole); this.drawLinks(); };
      quietly(async () => { await this.downloads.load(session, offer); offer(); });
    }
    this.draw();
    if (first || sealed || grown) await this.loadRest(whole, sealed);
  }

  showWhole(whole) {
    const all = this.view && views.isWhole(this.view, this.durationS);
    this.durationS = whole.durationS;
    if (!this.view) {
      this.view = views.fromLink(location.search, this.durationS);
      this.cursorS = views.cursorFromLink(location.search, this.durationS);
    } else this.view = all ? views.whole(this.durationS) : views.clamped(this.view, this.durationS);
    this.plots.show(whole);
    this.plots.heat = null;
    if (!whole.provisional) { // older bins are provisional
      this.plots.detail = null;
      this.loader.key = null;
    }
    const tiles = whole.serials.length;
    byId("as-heat").hidden = tiles < 2 || tiles > 32;
    this.downloads.offer(whole);
    this.replay.open(this.session.id, whole);
  }

  /** Load the rest: the plots do not wait for it. */
  async loadRest(whole, sealed) {
    const [array, stances, events, summary] = await Promise.all([
      unlessRefused(api.arrayOf(this.session.id)),
      whole.estimated && sealed ? unlessRefused(api.listStances(this.session.id)) : null,
      unlessRefused(api.listMarkers(this.session.id)), unlessRefused(api.clockOf(this.session.id)),
    ]);
    if (array) this.replay.setArray(array);
    this.onArray();
    const clock = moveClock(whole.axis, this.session.parts, summary);
    setText(byId("axis-note"), axisText(whole.axis));
    this.plots.stances = withSeconds(moveStances(whole.axis, stances ?? []), whole.beginNs);
    this.stances.show(this.plots.stances);
    quietly(() => this.showOverlay());
    const offset = (tNs, ofServer) => (clock && offsetAt(clock, tNs, ofServer));
    this.markers.show(events?.items ?? [], whole.beginNs, offset);
    this.plots.markers = this.markers.placed;
    this.draw();
    if (!sealed) return;
    quietly(() => this.showCompare(offset));
    quietly(() => this.showVideos());
  }

  /** Offer an overlay; its modules load on request, or if there is a reference. */
  async showCompare(offset) {
    const references = (await unlessRefused(api.listComparisons(this.session.id), () => ({ items: [] }))).items;
    const open = async () => {
      byId("compare").hidden = true;
      const { Compare } = await loadModule(() => import("./compare.js"));
      await new Compare(this.session, this, offset, references).begin();
    };
    const asked = new URLSearchParams(location.search);
    if (references.length || asked.has("with") || asked.has("reference")) return open();
    byId("compare").hidden = false;
    byId("compare").addEventListener("click", () => quietly(async () => {
      await open();
      byId("beside", HTMLSelectElement).focus();
    }));
  }

  /** Show the session's videos; their modules load with the first one, or for an upload. */
  async showVideos() {
    const found = await unlessRefused(videoApi.listVideos(this.session.id));
    const card = byId("videos-card");
    card.hidden = !found || (!found.items.length && !found.problems.length && !isOperator());
    if (card.hidden) return;
    setText(byId("videos-problem"), found.problems.join(" "));
    const load = async () => {
      const { Videos } = await loadModule(() => import("./videos.js"));
      this.videos ??= new Videos(this);
      await this.videos.show(found.items);
    };
    if (found.items.length) await load();
    else for (const name of ["pointerenter", "focusin", "dragenter"]) card.addEventListener(name, () => { if (!this.videos) quietly(load); }, { once: true });
  }

  /** Show the stance overlay; its modules load only if there are stances. */
  async showOverlay() {
    if (!this.plots.stances.length) return;
    const { StanceOverlay } = await loadModule(() => import("./stance_overlay.js"));
    this.overlay = new StanceOverlay(this.session.id, this.plots.stances, (index) => this.goTo(index));
    quietly(() => this.overlay.setOverlay(this.other));
  }

  /** Set the session whose stances are overlaid; null: none. @param {{id: string, name: string} | null} other */
  setOverlay(other) {
    this.other = other;
    quietly(() => this.overlay?.setOverlay(other));
  }

  listen() {
    const { plots } = this;
    const time = (px) => plots.timeAt(px, this.view);
    const scale = () => (this.view.to - this.view.from) / plots.plotWidth;
    bindGestures(byId("plots"), {
      point: (px, hovering = false) => { if (!hovering || !this.replay.playing.going) this.point(time(px)); },
      tap: (px) => { this.selectStance(stanceAt(plots.stances, time(px))); this.point(time(px)); },
      grab: (px, py) => { const id = flagAt(plots, px, py); return id !== null && isOperator() && this.markers.grab(id); },
      drag: (px) => this.markers.drag(time(px)),
      drop: (px) => this.markers.drop(px === null ? null : time(px)),
      choosing: (from, to) => { this.chosen = [time(from), time(to)]; this.draw(); },
      choose: (from, to) => {
        this.chosen = null;
        const [a, b] = [time(from), time(to)];
        if (from !== to) this.show({ from: Math.min(a, b), to: Math.max(a, b) });
        else this.draw();
      },
      zoom: (factor, px) => this.show(views.zoomed(this.view, factor, time(px), this.durationS)),
      move: (px) => this.show(views.moved(this.view, px * scale(), this.durationS)),
      all: () => this.showAll(),
      key: (event) => this.key(event),
    });
    const buttons = {
      "zoom-in": () => this.zoom(1 / KEY_ZOOM), "zoom-out": () => this.zoom(KEY_ZOOM), "zoom-all": () => this.showAll(),
      earlier: () => this.move(-0.5), later: () => this.move(0.5),
      "stance-before": () => this.step(-1), "stance-next": () => this.step(1),
      "as-heat": () => this.toggleHeat(), "copy-link": () => this.copyLink(),
      export: () => { this.downloads.selectStance(); this.drawLinks(); },
      picture: () => savePicture(plots, this.session),
    };
    for (const [name, act] of Object.entries(buttons)) byId(name).addEventListener("click", act);
    byId("plots-card").addEventListener("click", (event) => {
      // After a click with a pointer the space bar plays; it does not press that button again.
      if (event.detail > 0 && isInside(event, "button:focus")) byId("plots").focus({ preventScroll: true });
    });
    byId("marker-here").addEventListener("submit", (event) => {
      event.preventDefault();
      quietly(() => this.markers.add(this.cursorS ?? this.middle));
    });
    byId("numbers-card", HTMLDetailsElement).addEventListener("toggle", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(byId("plots"));
  }

  /** Number of the selected stance if the view shows a part of it; null: none. */
  get shownStance() {
    const stance = this.stances.stances[this.stances.current];
    return stance && stance.from < this.view.to && stance.to > this.view.from ? stance.number : null;
  }

  get middle() { return (this.view.from + this.view.to) / 2; }

  show(view) {
    this.view = views.clamped(view, this.durationS);
    byId("plots").dataset.settled = "false";
    this.updateUrlSoon();
    this.draw();
  }

  /** Update the URL after a pause: browsers limit its changes. */
  updateUrlSoon() {
    clearTimeout(this.linking);
    this.linking = setTimeout(() => this.updateUrl(), SETTLED_MS);
  }

  /** Write range, cursor and selected stance to the URL; a stance that is not loaded yet stays. */
  updateUrl() {
    clearTimeout(this.linking);
    const stance = this.stances.current < 0 ? this.stances.selected : this.shownStance;
    history.replaceState(null, "", location.pathname + views.toLink(this.view, this.durationS, location.search, this.cursorS, stance));
  }

  copyLink() {
    this.updateUrl();
    const copied = copyText(location.href);
    notice(copied ? "Link copied (range, cursor, selected stance)." : `copying is blocked. Link: ${location.href}`, { bad: !copied });
  }

  showAll() {
    this.deselect();
    this.show(views.whole(this.durationS));
  }

  /** Select a stance until another is selected; -1: none is there, the selected one stays. */
  selectStance(index) {
    if (index < 0) return;
    this.stances.selected = this.plots.stances[index].number;
  }

  deselect() {
    this.stances.selected = null;
    this.updateUrlSoon();
    this.draw();
  }

  /** Zoom about the cursor, if visible. */
  zoom(factor) {
    const { view, cursorS } = this;
    const about = cursorS !== null && cursorS >= view.from && cursorS <= view.to ? cursorS : this.middle;
    this.show(views.zoomed(view, factor, about, this.durationS));
  }

  move(share) { this.show(views.moved(this.view, share * (this.view.to - this.view.from), this.durationS)); }

  point(timeS) {
    this.cursorS = timeS;
    this.updateUrlSoon();
    this.draw();
  }

  /** Move the cursor; the view follows by 0.9 of its width. */
  cursorTo(timeS) {
    this.cursorS = timeS;
    const { view } = this;
    const beyond = Math.max(0, timeS - view.to) - Math.max(0, view.from - timeS);
    if (beyond) this.show(views.moved(view, beyond + Math.sign(beyond) * 0.9 * (view.to - view.from), this.durationS));
    else {
      this.updateUrlSoon();
      this.draw();
    }
  }

  step(by) { this.stances.step(by, this.cursorS, this.view); }

  goTo(index) {
    const stance = this.plots.stances[index];
    this.selectStance(index);
    this.cursorS = stance.peakS ?? stance.from;
    this.show(views.around(stance.from, stance.to, this.durationS));
  }

  goToMarker(timeS) {
    this.cursorS = timeS;
    const half = Math.min(1, (this.view.to - this.view.from) / 2);
    this.show({ from: timeS - half, to: timeS + half });
  }

  toggleHeat() {
    const { plots } = this;
    plots.asHeat = !plots.panels.some((panel) => panel.kind === "heat");
    plots.show(plots.whole);
    this.draw();
  }

  key(event) {
    const onButton = event.target.closest?.("button, a, summary");
    const acts = {
      "+": () => this.zoom(1 / KEY_ZOOM), "=": () => this.zoom(1 / KEY_ZOOM), "-": () => this.zoom(KEY_ZOOM),
      "[": () => this.step(-1), "]": () => this.step(1),
      Escape: () => this.deselect(),
      ArrowLeft: () => this.replay.walk(-1, event.shiftKey), ArrowRight: () => this.replay.walk(1, event.shiftKey),
    };
    if (!onButton) acts[" "] = () => this.replay.toggle();
    if (this.videos) Object.assign(acts, { ",": () => this.videos.card.step(-1), ".": () => this.videos.card.step(1) });
    if (event.target.closest?.("#stances-scroll, .scroll")) { // they scroll the table there
      delete acts.ArrowLeft;
      delete acts.ArrowRight;
    }
    // They scroll the page, too: handled on the plots only.
    if (event.target === byId("plots")) {
      Object.assign(acts, { Home: () => this.showAll(), PageUp: () => this.move(-0.5), PageDown: () => this.move(0.5) });
    } else if (!onButton) acts.Home = () => this.showAll();
    acts[event.key]?.();
    return event.key in acts;
  }

  showDetail(bins) {
    this.plots.detail = bins;
    this.draw();
  }

  /** Draw again: the overlay has changed. */
  redraw() {
    this.drawnKey = null;
    this.draw();
  }

  draw() {
    this.drawing ||= requestAnimationFrame(() => {
      this.drawing = 0;
      this.drawNow();
    });
  }

  drawNow() {
    const { plots, view } = this;
    const box = byId("plots");
    if (!view || !box.clientWidth) return;
    box.dataset.whole = String(views.isWhole(view, this.durationS));
    box.dataset.from = view.from.toFixed(4);
    box.dataset.to = view.to.toFixed(4);
    this.stances.draw();
    this.overlay?.choose(this.stances.current);
    const drawnKey = [view.from, view.to, plots.width, plots.whole, plots.detail, this.markers.version, plots.stances.length, plots.asHeat,
      this.stances.current, plots.colours, devicePixelRatio];
    if (drawnKey.some((one, i) => one !== this.drawnKey?.[i])) {
      plots.draw(view, this.stances.current);
      drawnKey[COLOURS_AT] = plots.colours;
      this.drawnKey = drawnKey;
      drawLegend(plots);
    }
    plots.drawCursor(view, this.cursorS, this.chosen);
    this.loader.want(view, plots.plotWidth, plots.best(view));
    plots.beside?.want(view, plots.plotWidth);
    const bins = plots.best(view);
    box.dataset.settled = String(!this.loader.busy && !plots.beside?.loader.busy);
    plots.beside?.writeData(view, box);
    drawSummary(bins, view, byId("summary"));
    const text = this.readout.draw(bins, this.cursorS, plots.panels,
      this.cursorS === null ? [] : plots.beside?.readings(view, this.cursorS));
    this.replay.draw();
    this.videos?.card.follow();
    if (!this.replay.playing.going) this.describeCursor(text); // not while playing: too fast for a screen reader
    byId("as-heat").setAttribute("aria-pressed", String(plots.panels.some((panel) => panel.kind === "heat")));
    setText(byId("marker-at"), this.cursorS === null ? "at mid-view" : "at cursor");
    this.drawLinks();
    this.numbers.draw(view, plots.panels);
  }

  describeCursor(text) {
    const box = byId("plots");
    box.setAttribute("aria-valuemin", "0");
    box.setAttribute("aria-valuemax", this.durationS.toFixed(3));
    box.setAttribute("aria-valuenow", (this.cursorS ?? this.middle).toFixed(3));
    box.setAttribute("aria-valuetext", text || byId("summary").textContent);
  }

  /** Update the download links. */
  drawLinks() {
    const session = { ...this.session, marker_count: this.plots.markers.length };
    const stance = this.stances.stances[this.stances.current];
    this.downloads.draw(session, this.view, views.isWhole(this.view, this.durationS), stance);
  }
}
