// API reference, drawn by Swagger UI from files of this server; a private server requires a login first.

import { call } from "../common/api.js";
import { logInFromUrl, needsLogin, waitForLogin } from "../common/login.js";
import { unlessRefused } from "../common/request.js";
import { byId, setText } from "../common/text.js";

const dark = matchMedia("(prefers-color-scheme: dark)");
const setTheme = () => document.documentElement.classList.toggle("dark-mode", dark.matches); // name of Swagger UI
dark.addEventListener("change", setTheme);
setTheme();

async function show() {
  await logInFromUrl();
  if (needsLogin()) await waitForLogin();
  const spec = await unlessRefused(call("GET", "/openapi.json"), ({ message }) => setText(byId("message"), message));
  byId("message").hidden = Boolean(spec);
  if (!spec) return;
  globalThis.SwaggerUIBundle({
    spec,
    domNode: byId("swagger"),
    deepLinking: true,
    filter: true,
    docExpansion: "list",
    defaultModelsExpandDepth: 0,
    displayRequestDuration: true,
    validatorUrl: null, // would be on another host
    onComplete: () => { document.body.dataset.state = "shown"; },
  });
}

show();
