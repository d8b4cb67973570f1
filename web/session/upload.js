// Upload of a file with its progress, which fetch does not tell.

import { resultOf } from "../common/api.js";
import { askToLogIn } from "../common/login.js";
import { Refusal } from "../common/request.js";

/**
 * Send a file; resolve to the parsed answer, reject with a Refusal, or with an AbortError after `stop`.
 * @param {string} path @param {File} file @param {(share: number) => void} onProgress @param {AbortSignal} stop
 */
export async function upload(path, file, onProgress, stop) {
  let { response, text } = await send(path, file, onProgress, stop);
  if (response.status === 401 && await askToLogIn()) ({ response, text } = await send(path, file, onProgress, stop));
  return resultOf(response, text);
}

/** @returns {Promise<{response: Response, text: string}>} */
function send(path, file, onProgress, stop) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", path);
    request.setRequestHeader("Accept", "application/json");
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.upload.addEventListener("progress", ({ loaded, total }) => onProgress(total ? loaded / total : 0));
    request.addEventListener("load", () => resolve({ response: new Response(null, request), text: request.responseText }));
    request.addEventListener("error", () => reject(new Refusal("The upload broke off: the server ended it, or cannot be reached. Check its free disk space and the network, then try again.", 0)));
    request.addEventListener("abort", () => reject(new DOMException("of the user", "AbortError")));
    stop.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}
