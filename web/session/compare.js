// Selection of the overlay: a reference of an earlier comparison, or another session.

import * as api from "../common/api.js";
import { quietly, showRefusal } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, localTime, number, roughly, setText } from "../common/text.js";
import { Beside } from "./beside.js";
import { alignments } from "./align.js";
import { drawDifferences } from "./differences.js";
import { drawReport } from "./report.js";
import { moveClock, moveStances } from "./time_axis.js";

const SESSIONS_MAX = 50; // older ones by URL
const SHARED = ["grf", "cop-x", "cop-y", "angle"];
const STEMS = { grf: "grf_n", "cop-x": "cop_x_m", "cop-y": "cop_y_m", angle: "angle_rad" };
const REFERENCE = {
  grf: ["reference_grf_n_min", "reference_grf_n_max"], difference: ["error_n_min", "error_n_max"],
  "cop-x": ["reference_cop_x_m_min", "reference_cop_x_m_max"], "cop-y": ["reference_cop_y_m_min", "reference_cop_y_m_max"],
};

/** Return a name that differs from this session's, such as "trial 3, right". */
function nameOf(other, session) {
  const name = `${other.name || other.id}, ${other.node}`;
  const isSame = other.name === session.name && other.node === session.node;
  return isSame ? `${name}, ${localTime(new Date(other.started_t_ns / 1e6))}` : name;
}

/** Return a session's name; if the other one has the same, its node or start. */
function shortNameOf(session, other) {
  if (session.name !== other.name) return session.name || session.id;
  return session.node === other.node ? localTime(new Date(session.started_t_ns / 1e6)) : session.node;
}

/** Controls of the overlay. */
export class Compare {
  /**
   * @param {SessionView} session
   * @param {import("./plotted.js").Plotted} page
   * @param {(tNs: number, ofServer: boolean) => number | null} offset of this session's node
   * @param {{name: string}[]} references of earlier comparisons
   */
  constructor(session, page, offset, references) {
    this.session = session;
    this.references = references;
    this.page = page;
    this.offset = offset;
    this.choice = byId("beside", HTMLSelectElement);
    this.align = byId("beside-align", HTMLSelectElement);
    this.choice.addEventListener("change", () => quietly(() => this.choose(this.choice.value)));
    this.align.addEventListener("change", () => { this.moveTo(this.align.value); this.updateUrl(); });
  }

  async begin() {
    const sessions = await unlessRefused(api.newestSessions(SESSIONS_MAX), () => ({ items: [] }));
    const others = sessions.items.filter((one) => one.id !== this.session.id && one.state === "sealed" && one.sha256);
    const query = new URLSearchParams(location.search);
    const wanted = ["reference", "with"].filter((key) => query.has(key)).map((key) => `${key}:${query.get(key)}`)[0] ?? "";
    const group = (label, options) => (options.length ? [el("optgroup", { label }, ...options)] : []);
    const references = this.references.map((one) => el("option", { value: `reference:${one.name}`, text: one.name }));
    const known = others.map((one) => el("option", { value: `with:${one.id}`, text: `${one.name || one.id}, ${one.node}, ${localTime(new Date(one.started_t_ns / 1e6))}` }));
    if (wanted.startsWith("with:") && !others.some((one) => `with:${one.id}` === wanted)) { // an older one, by URL
      known.push(el("option", { value: wanted, text: wanted.slice(5) }));
    }
    this.choice.replaceChildren(el("option", { value: "", text: "none" }),
      ...group("References (foottile compare)", references), ...group("Other sessions", known));
    byId("beside-choice").hidden = false;
    if (!references.length && !known.length) this.showText("No other sealed session, and no result of foottile compare.");
    if (!wanted) return;
    this.choice.value = wanted;
    await this.choose(wanted, query.get("align"));
  }

  async choose(wanted, align = null) {
    this.wanted = wanted;
    this.show(null);
    this.page.setOverlay(null);
    byId("report-card").hidden = byId("differences-card").hidden = true;
    byId("align-choice").hidden = true;
    this.showText("");
    this.updateUrl();
    const shown = wanted.startsWith("reference:") ? this.showReference(wanted.slice(10))
      : wanted.startsWith("with:") ? this.showSession(wanted.slice(5), align) : Promise.resolve();
    await unlessRefused(shown, ({ message }) => this.showText(message));
  }

  /** Show a reference; it has this session's time axis. */
  async showReference(name) {
    const wanted = this.wanted;
    const found = await api.getComparison(this.session.id, name);
    if (wanted !== this.wanted) return;
    drawReport(found);
    if (!found.has_series) return this.showText("Figures only: the comparison has too many frames for a series.");
    const beside = this.beside(name, REFERENCE, (query, stop) => api.comparisonSeries(this.session.id, name, query, stop));
    await beside.begin(this.page.plots.plotWidth);
    if (wanted === this.wanted) this.show(beside);
  }

  /** Show another session, aligned as selected. */
  async showSession(id, align) {
    const wanted = this.wanted;
    const [other, stances, events, clock, array] = await Promise.all([
      api.getSession(id), ...[api.listStances(id), api.listMarkers(id), api.clockOf(id), api.arrayOf(id)].map((asked) => unlessRefused(asked)),
    ]);
    const columns = Object.fromEntries(SHARED.map((key) => [key, [`${STEMS[key]}_min`, `${STEMS[key]}_max`]]));
    const beside = this.beside(nameOf(other, this.session), columns, (query, stop) => api.overview(id, query, stop));
    await beside.begin(this.page.plots.plotWidth);
    if (wanted !== this.wanted) return;
    beside.matchTiles(this.page.plots.whole.serials);
    for (const key of SHARED) if (!(columns[key][0] in beside.answer.columns)) delete beside.columns[key];
    if (!Object.keys(beside.columns).length) return this.showText("The other session has no estimates.");
    const { plots } = this.page;
    this.ways = alignments(
      { beginNs: plots.whole.beginNs, durationS: this.page.durationS, take: this.session.take, stances: plots.stances, markers: plots.markers, offset: this.offset },
      { beginNs: beside.answer.begin_t_ns, durationS: beside.durationS, take: other.take,
        stances: moveStances(beside.answer.time_axis, stances ?? []), events: events?.items ?? [],
        clock: moveClock(beside.answer.time_axis, other.parts, clock) },
    );
    this.align.replaceChildren(...this.ways.map((way) => el("option", { value: way.key, text: way.label })));
    byId("align-choice").hidden = false;
    this.drawn = beside;
    this.sameTake = this.session.take !== null && this.session.take === other.take;
    this.apartS = (other.started_t_ns - this.session.started_t_ns) * 1e-9;
    const own = { name: shortNameOf(this.session, other), stances: plots.stances, tares: this.page.replay.array?.tares ?? [] };
    const theirs = { name: shortNameOf(other, this.session), stances: stances ?? [], tares: array?.tares ?? [] };
    if (this.apartS < 0) drawDifferences(theirs, own);
    else drawDifferences(own, theirs);
    this.page.setOverlay({ id, name: beside.name });
    this.moveTo(this.ways.some((way) => way.key === align) ? align : this.ways[0].key);
    this.show(beside);
  }

  beside(name, columns, ask) {
    return new Beside({
      name, columns: { ...columns }, ask, onChange: () => this.page.redraw(),
      onError: showRefusal,
    });
  }

  moveTo(key) {
    const way = this.ways.find((one) => one.key === key);
    this.align.value = key;
    this.drawn.move(way.shiftS);
    this.drawn.aligned = way.meaning;
    const shift = way.shiftS === 0 ? "" : ` (shifted by ${number(way.shiftS, 3)} s)`;
    const apart = this.sameTake ? "of the same take" : `recorded ${roughly(Math.abs(this.apartS))} ${this.apartS < 0 ? "earlier" : "later"}`;
    this.showText(`${this.drawn.name} (${apart}): ${way.meaning}${shift}.`, way.shiftS);
    this.page.redraw();
  }

  show(beside) {
    const { plots } = this.page;
    plots.beside = beside;
    if (plots.whole) plots.show(plots.whole);
    this.page.redraw();
    if (beside) this.updateUrl();
  }

  showText(text, shiftS = null) {
    const line = byId("beside-summary");
    line.hidden = !text;
    line.dataset.shiftS = shiftS === null ? "" : String(shiftS);
    setText(line, text);
  }

  /** Write the selection to the URL. */
  updateUrl() {
    const fields = new URLSearchParams(location.search);
    for (const name of ["with", "reference", "align"]) fields.delete(name);
    const [kind, ...rest] = (this.wanted ?? "").split(":");
    if (kind) fields.set(kind, rest.join(":"));
    if (kind === "with" && this.align.value && !byId("align-choice").hidden) fields.set("align", this.align.value);
    history.replaceState(null, "", location.pathname + (String(fields) && `?${fields}`));
  }
}
