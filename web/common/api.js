// REST client of the pages. The login is a cookie: login.js.

import { askToLogIn } from "./login.js";
import { parseResponse, TIMEOUT_S, Refusal, sendRequest } from "./request.js";

export { Refusal };

export const PREFIX = "/api/v1";
const JSON_TYPE = "application/json";

/**
 * Call the API; resolve to the parsed response (null for 204), reject with a Refusal. `stop` aborts it;
 * `said` is sent as If-Match: 412 if the resource has changed.
 * @param {string} method
 * @param {string} path
 * @param {{body?: any, stop?: AbortSignal | null, type?: string, said?: string | null, timeoutS?: number}} [how]
 */
export async function call(method, path, { body, stop = null, type = JSON_TYPE, said = null, timeoutS = TIMEOUT_S } = {}) {
  const headers = { Accept: type };
  if (said !== null) headers["If-Match"] = `"${said}"`;
  if (body !== undefined) headers["Content-Type"] = JSON_TYPE;
  const options = { method, headers, body: body === undefined || body instanceof Blob ? body : JSON.stringify(body) };
  let { response, text } = await sendRequest(PREFIX + path, options, { timeoutS, stop });
  if (response.status === 401 && await askToLogIn()) ({ response, text } = await sendRequest(PREFIX + path, options, { timeoutS, stop }));
  if (response.status === 204) return null;
  if (response.ok && type !== JSON_TYPE) return text;
  return resultOf(response, text);
}

/** Return the parsed answer, or throw its refusal. @param {Response} response @param {string} text */
export function resultOf(response, text) {
  const answer = parseResponse(response, text);
  if (response.ok) return answer;
  throw new Refusal(String(answer?.detail || answer?.title || `The server refused (${response.status}).`), response.status);
}

export const id = encodeURIComponent;
/** @param {Record<string, string | number>} query */
export const encoded = (query) => new URLSearchParams(Object.entries(query).map(([name, value]) => [name, String(value)]));
export const recent = (node, seconds, before, tiles) =>
  call("GET", `/nodes/${id(node)}/history?seconds=${seconds}${before === undefined ? "" : `&before_seq=${before}`}${tiles ? `&tiles=${tiles}` : ""}`);
export const tareNow = (node) => call("POST", `/nodes/${id(node)}/tare`, { body: {} });
/** @type {(node: string, fingerprint: string) => Promise<void>} */
export const acceptReplacement = (node, fingerprint) => call("POST", `/nodes/${id(node)}/accept-replacement`, { body: { fingerprint } });
export const listTares = (node) => call("GET", `/nodes/${id(node)}/tares`);
/** @type {(node: string) => Promise<NodeCalibrationView>} */
export const calibrationOf = (node) => call("GET", `/nodes/${id(node)}/calibration`);
/** @type {(node: string, calibration: string, revision: string) => Promise<NodeCalibrationView>} */
export const assignCalibration = (node, calibration, said) =>
  call("PUT", `/nodes/${id(node)}/calibration`, { body: { id: calibration }, said });
/** @type {(node: string, revision: string) => Promise<NodeCalibrationView>} */
export const unassignCalibration = (node, said) => call("DELETE", `/nodes/${id(node)}/calibration`, { said });
/** @type {() => Promise<Page_CalibrationSummaryView_>} */
export const listCalibrations = () => call("GET", "/calibrations");
/** Upload a file unchanged: its hash covers every byte. @type {(file: Blob) => Promise<CalibrationSummaryView>} */
export const uploadCalibration = (file) => call("POST", "/calibrations", { body: file });
export const deleteCalibration = (calibration) => call("DELETE", `/calibrations/${id(calibration)}`);
/** @type {(node: string) => Promise<NodeWeighingView>} */
export const weighingOf = (node) => call("GET", `/nodes/${id(node)}/weighing`);
/** @type {(node: string, plan: StartWeighing) => Promise<WeighingView>} */
export const startWeighing = (node, plan) => call("POST", `/nodes/${id(node)}/weighing`, { body: plan });
/** @type {(node: string, revision: string) => Promise<WeighingView>} */
export const repeatWeight = (node, said) => call("POST", `/nodes/${id(node)}/weighing/repeat`, { said });
export const endWeighing = (node, said) => call("DELETE", `/nodes/${id(node)}/weighing`, { said });
export const undoTare = (node, tare) => call("DELETE", `/nodes/${id(node)}/tares/${id(tare)}`);
/** @type {(node: string, name: string) => Promise<SessionView>} */
export const startSession = (node, name) => call("POST", "/sessions", { body: { node, name } });
/** Ids of sessions and takes that this page has stopped. @type {Set<string>} */
export const ownStops = new Set();
function stop(kind, one) {
  ownStops.add(one);
  return call("POST", `/${kind}/${id(one)}/stop`);
}
/** @type {(session: string) => Promise<SessionView>} */
export const stopSession = (session) => stop("sessions", session);
/** @type {(session: string, marker: object) => Promise<MarkerView>} */
export const addMarker = (session, marker) => call("POST", `/sessions/${id(session)}/markers`, { body: marker });
/** @type {(name: string) => Promise<TakeView>} */
export const startTake = (name) => call("POST", "/takes", { body: { name } });
/** @type {(take: string) => Promise<TakeView>} */
export const getTake = (take) => call("GET", `/takes/${id(take)}`);
/** @type {(take: string) => Promise<TakeView>} */
export const stopTake = (take) => stop("takes", take);
/** @type {(take: string, marker: object) => Promise<TakeView>} */
export const addTakeMarker = (take, marker) => call("POST", `/takes/${id(take)}/markers`, { body: marker });
/** @type {(text: string) => Promise<TrialsView>} */
export const setTrials = (text) => call("PUT", "/trials", { body: text });
/** @type {(changes: object) => Promise<TrialsView>} */
export const changeTrials = (changes) => call("PATCH", "/trials", { body: changes });
/** @type {() => Promise<TrialsView>} */
export const recordTrial = () => call("POST", "/trials/record", { body: {} });
/** @type {(session: string) => Promise<SessionView>} */
export const getSession = (session) => call("GET", `/sessions/${id(session)}`);
/** @type {(session: string) => Promise<Page_MarkerView_>} */
export const listMarkers = (session) => call("GET", `/sessions/${id(session)}/markers`);
export const listStances = (session) => call("GET", `/sessions/${id(session)}/stances`);
export const stancesOverlay = (session) => call("GET", `/sessions/${id(session)}/stances/overlay`);
export const listComparisons = (session) => call("GET", `/sessions/${id(session)}/comparisons`);
export const getComparison = (session, name) => call("GET", `/sessions/${id(session)}/comparisons/${id(name)}`);
export const comparisonSeries = (session, name, query, stop) =>
  call("GET", `/sessions/${id(session)}/comparisons/${id(name)}/series?${encoded(query)}`, { stop });
export const newestSessions = (limit) => call("GET", `/sessions?limit=${limit}`);
/** @type {(session: string) => Promise<ArrayView>} */
export const arrayOf = (session) => call("GET", `/sessions/${id(session)}/tiles`);
export const ledgerOf = (session) => call("GET", `/sessions/${id(session)}/ledger`);
/** Verify all files on the server: slow for a long session. @type {(session: string) => Promise<VerificationView>} */
export const verifyFiles = (session) => call("GET", `/sessions/${id(session)}/verification`, { timeoutS: 300 });
/** @type {(session: string) => Promise<ClockSummary>} */
export const clockOf = (session) => call("GET", `/sessions/${id(session)}/clock`);
/** @typedef {{points: number, start_s?: number, end_s?: number, columns?: string}} OverviewQuery */
/** @type {(session: string, query: OverviewQuery, stop?: AbortSignal) => Promise<OverviewView>} */
export const overview = (session, query, stop) =>
  call("GET", `/sessions/${id(session)}/timeseries?${encoded(query)}`, { stop });
/** Return some seconds of a session's frames, as CSV. */
export const samples = (session, query) =>
  call("GET", `/sessions/${id(session)}/data?${encoded({ format: "csv", markers: "false", ...query })}`, { type: "text/csv" });
/** @type {(session: string, changes: object, said?: string | null) => Promise<SessionView>} */
export const changeSession = (session, changes, said = null) =>
  call("PATCH", `/sessions/${id(session)}`, { body: changes, said });
/** @type {(session: string, marker: string, changes: object, revision: string) => Promise<MarkerView>} */
export const changeMarker = (session, marker, changes, said) =>
  call("PATCH", `/sessions/${id(session)}/markers/${id(marker)}`, { body: changes, said });
export const removeMarker = (session, marker, said) =>
  call("DELETE", `/sessions/${id(session)}/markers/${id(marker)}`, { said });
/** @type {(session: string) => Promise<SessionView>} */
export const sealSession = (session) => call("POST", `/sessions/${id(session)}/abandon-missing`);
export const deleteSession = (session) => call("DELETE", `/sessions/${id(session)}`);
export const listTrash = () => call("GET", "/trash");
/** @type {(session: string) => Promise<SessionView>} */
export const restoreSession = (session) => call("POST", `/trash/${id(session)}/restore`);
export const emptyTrash = () => call("DELETE", "/trash");
/** @type {(query: {limit: number, cursor?: string, q?: string, complete?: string, node?: string, from?: string}) => Promise<SessionPage>} */
export const listSessions = (query) => call("GET", `/sessions?${encoded(query)}`);
export const zipAddress = (ids) => `${PREFIX}/sessions/zip?ids=${ids.map(id).join(",")}`;
export const listFormats = () => call("GET", "/formats");
/** Return the address of a download, with markers if there are any; Parquet without is the sealed file. */
export const dataAddress = (session, format, part = "") =>
  `${PREFIX}/sessions/${id(session.id)}/data?format=${format}${session.marker_count ? "&markers=true" : ""}${part}`;
/**
 * Return the remarks on a download, such as filled gaps; reject with a Refusal if the server refuses it.
 * @param {string} address
 */
export async function checkDownload(address) {
  const limits = { timeoutS: 120 }; // an hour of frames
  const { response } = await sendRequest(address, { method: "HEAD" }, limits);
  if (response.ok) return response.headers.get("Foottile-Remarks") ?? "";
  const refused = await sendRequest(address, { method: "GET" }, limits); // HEAD has no reason
  return refused.response.ok ? "" : resultOf(refused.response, refused.text);
}
/** Return the address of a download of a take. */
export const takeDataAddress = (take, format, part = "") => `${PREFIX}/takes/${id(take)}/data?format=${format}${part}`;
