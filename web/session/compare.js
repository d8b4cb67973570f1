// Chooses what is drawn beside a session: a reference it was compared with, or another session.

import * as api from "../common/api.js";
import { notice, quietly, showRefusal } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, localTime, number, setText } from "../common/text.js";
import { Beside } from "./beside.js";
import { alignments } from "./align.js";
import { drawReport } from "./report.js";
import { clockOn, stancesOn } from "./time_axis.js";

const SESSIONS_MOST = 50; // older ones by their link
const SAME = ["grf", "cop-x", "cop-y", "angle"];
const STEMS = { grf: "grf_n", "cop-x": "cop_x_m", "cop-y": "cop_y_m", angle: "angle_rad" };
const REFERENCE = {
  grf: ["reference_grf_n_min", "reference_grf_n_max"], difference: ["error_n_min", "error_n_max"],
  "cop-x": ["reference_cop_x_m_min", "reference_cop_x_m_max"], "cop-y": ["reference_cop_y_m_min", "reference_cop_y_m_max"],
};

/** "trial 3, right": a name that tells it from this session, whose name may be the same. */
function nameOf(other, session) {
  const name = `${other.name || other.id}, ${other.node}`;
  const isSame = other.name === session.name && other.node === session.node;
  return isSame ? `${name}, ${localTime(new Date(other.started_t_ns / 1e6))}` : name;
}

export class Compare {
  /**
   * @param {{id: string}} session
   * @param {import("./plotted.js").Plotted} page
   * @param {(tNs: number, ofServer: boolean) => number | null} offset of this session's node
   * @param {{name: string}[]} references that it was compared with
   */
  constructor(session, page, offset, references) {
    this.session = session;
    this.references = references;
    this.page = page;
    this.offset = offset;
    this.choice = byId("beside", HTMLSelectElement);
    this.align = byId("beside-align", HTMLSelectElement);
    this.choice.addEventListener("change", () => quietly(() => this.choose(this.choice.value)));
    this.align.addEventListener("change", () => { this.moveTo(this.align.value); this.link(); });
  }

  async begin() {
    const sessions = await unlessRefused(api.newestSessions(SESSIONS_MOST), { items: [] });
    const others = sessions.items.filter((one) => one.id !== this.session.id && one.state === "sealed" && one.sha256);
    const asked = new URLSearchParams(location.search);
    const wanted = asked.has("against") ? `against:${asked.get("against")}` : asked.has("with") ? `with:${asked.get("with")}` : "";
    const group = (label, options) => (options.length ? [el("optgroup", { label }, ...options)] : []);
    const references = this.references.map((one) => el("option", { value: `against:${one.name}`, text: one.name }));
    const known = others.map((one) => el("option", { value: `with:${one.id}`, text: `${one.name || one.id}, ${one.node}, ${localTime(new Date(one.started_t_ns / 1e6))}` }));
    if (wanted.startsWith("with:") && !others.some((one) => `with:${one.id}` === wanted)) { // an older one, by its link
      known.push(el("option", { value: wanted, text: wanted.slice(5) }));
    }
    this.choice.replaceChildren(el("option", { value: "", text: "nothing" }),
      ...group("References, by foottile compare", references), ...group("Other sessions", known));
    byId("beside-choice").hidden = false;
    if (!references.length && !known.length) this.say("There is no other session that is sealed, and foottile compare has kept nothing with this one.");
    if (!wanted) return;
    this.choice.value = wanted;
    await this.choose(wanted, asked.get("align"));
  }

  async choose(wanted, align = null) {
    this.wanted = wanted;
    this.show(null);
    this.page.layBeside(null);
    byId("report-card").hidden = true;
    byId("align-choice").hidden = true;
    this.say("");
    this.link();
    try {
      if (wanted.startsWith("against:")) await this.against(wanted.slice(8));
      else if (wanted.startsWith("with:")) await this.with(wanted.slice(5), align);
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      this.say(error.message);
    }
  }

  /** A reference: at this session's time already. */
  async against(name) {
    const wanted = this.wanted;
    const found = await api.getComparison(this.session.id, name);
    if (wanted !== this.wanted) return;
    drawReport(found);
    if (!found.has_series) return this.say("It was made by an older version, or is too long to be drawn: only its figures are there.");
    const beside = this.beside(name, REFERENCE, (query, stop) => api.comparisonSeries(this.session.id, name, query, stop));
    await beside.begin(this.page.plots.plotWidth);
    if (wanted === this.wanted) this.show(beside);
  }

  /** Another session: moved as is chosen. */
  async with(id, align) {
    const wanted = this.wanted;
    const [other, stances, events, clock] = await Promise.all([
      api.getSession(id), unlessRefused(api.listStances(id)), unlessRefused(api.listEvents(id)), unlessRefused(api.clockOf(id)),
    ]);
    const columns = Object.fromEntries(SAME.map((key) => [key, [`${STEMS[key]}_min`, `${STEMS[key]}_max`]]));
    const beside = this.beside(nameOf(other, this.session), columns, (query, stop) => api.overview(id, query, stop));
    await beside.begin(this.page.plots.plotWidth);
    if (wanted !== this.wanted) return;
    beside.matchTiles(this.page.plots.whole.serials);
    for (const key of SAME) if (!(columns[key][0] in beside.answer.columns)) delete beside.columns[key];
    if (!Object.keys(beside.columns).length) return this.say("It has no estimates: there is nothing to draw beside this one.");
    const { plots } = this.page;
    this.ways = alignments(
      { beginNs: plots.whole.beginNs, durationS: this.page.durationS, stances: plots.stances, marks: plots.marks, offset: this.offset },
      { beginNs: beside.answer.begin_t_ns, durationS: beside.durationS,
        stances: stancesOn(beside.answer.time_axis, stances ?? []), events: events?.items ?? [],
        clock: clockOn(beside.answer.time_axis, other.parts, clock) },
    );
    this.align.replaceChildren(...this.ways.map((way) => el("option", { value: way.key, text: way.says })));
    byId("align-choice").hidden = false;
    this.drawn = beside;
    this.page.layBeside({ id, name: beside.name });
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
    const shift = way.shiftS === 0 ? "not moved" : `moved by ${number(way.shiftS, 3)} s`;
    this.say(`${this.drawn.name} is ${shift}: ${way.because}.`, way.shiftS);
    this.page.redraw();
  }

  show(beside) {
    const { plots } = this.page;
    plots.beside = beside;
    if (plots.whole) plots.show(plots.whole);
    this.page.redraw();
    if (beside) this.link();
  }

  say(text, shiftS = null) {
    const line = byId("beside-says");
    line.hidden = !text;
    line.dataset.shiftS = shiftS === null ? "" : String(shiftS);
    setText(line, text);
  }

  /** The address says it, too. */
  link() {
    const fields = new URLSearchParams(location.search);
    for (const name of ["with", "against", "align"]) fields.delete(name);
    const [kind, ...rest] = (this.wanted ?? "").split(":");
    if (kind) fields.set(kind, rest.join(":"));
    if (kind === "with" && this.align.value && !byId("align-choice").hidden) fields.set("align", this.align.value);
    history.replaceState(null, "", location.pathname + (String(fields) && `?${fields}`));
  }
}
