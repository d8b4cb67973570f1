// The API's description, drawn by Swagger UI from files of this server; a private one asks for a login first.

import { call, Refusal } from "../common/api.js";
import { enter, keptOut, letIn } from "../common/login.js";
import { byId, setText } from "../common/text.js";

const dark = matchMedia("(prefers-color-scheme: dark)");
const dress = () => document.documentElement.classList.toggle("dark-mode", dark.matches); // Swagger UI's own name
dark.addEventListener("change", dress);
dress();

async function show() {
  await enter();
  if (keptOut()) await letIn();
  let spec;
  try {
    spec = await call("GET", "/openapi.json");
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    byId("message").hidden = false;
    setText(byId("message"), error.message);
    return;
  }
  globalThis.SwaggerUIBundle({
    spec,
    domNode: byId("swagger"),
    deepLinking: true,
    filter: true,
    docExpansion: "list",
    defaultModelsExpandDepth: 0,
    displayRequestDuration: true,
    validatorUrl: null, // it would be another host's
    onComplete: () => { document.body.dataset.state = "shown"; },
  });
}

show();
