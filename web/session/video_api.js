// Requests about the films of a session.

import { call, encoded, id, PREFIX } from "../common/api.js";

/** @type {(session: string) => Promise<VideosView>} */
export const listVideos = (session) => call("GET", `/sessions/${id(session)}/videos`);
/** Return the address to upload a film to. @param {string} session @param {string} name @param {string} captureRateHz */
export const videosAddress = (session, name, captureRateHz) =>
  `${PREFIX}/sessions/${id(session)}/videos?${encoded({ name, ...(captureRateHz && { capture_rate_hz: captureRateHz }) })}`;
const ofVideo = (session, video, part = "") => `/sessions/${id(session)}/videos/${id(video)}${part}`;
export const removeVideo = (session, video) => call("DELETE", ofVideo(session, video));
export const filmAddress = (session, video) => PREFIX + ofVideo(session, video, "/film");
/** Return the address of a film with the pictures that its edit list hides. */
export const wholeFilmAddress = (session, video) => `${filmAddress(session, video)}?whole=true`;
/** @type {(session: string, video: string) => Promise<TimesView>} */
export const filmTimes = (session, video) => call("GET", ofVideo(session, video, "/times"), { timeoutS: 120 });
/** `replace`: also an alignment that it contradicts. @type {(session: string, video: string, pairs: object, replace: boolean) => Promise<Video>} */
export const setAlignment = (session, video, pairs, replace) => call("PUT", ofVideo(session, video, `/alignment?replace=${replace}`), { body: pairs });
/** Let the server find it in the pictures: slow. @type {(session: string, video: string, method: string, replace: boolean) => Promise<Video>} */
export const findAlignment = (session, video, method, replace) =>
  call("POST", ofVideo(session, video, `/alignment?${encoded({ method, replace: String(replace) })}`), { timeoutS: 3600 });
/** @type {(session: string, video: string) => Promise<Video>} */
export const removeAlignment = (session, video) => call("DELETE", ofVideo(session, video, "/alignment"));
