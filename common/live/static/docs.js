// Shows the paths of the server from its openapi.json, and the answer of each.

import { askToken, authorization } from "./stream.js";

const SHOWN_MAX = 20000; // characters of an answer

async function ask(path) {
  for (;;) {
    const answer = await fetch(path, { headers: authorization(), cache: "no-store" });
    if (answer.status !== 401) return answer;
    await askToken();
  }
}

function element(name, text, parent) {
  const made = document.createElement(name);
  made.textContent = text;
  parent.append(made);
  return made;
}

async function show(path, into) {
  const answer = await ask(path.slice(1)), text = await answer.text();
  const json = (answer.headers.get("content-type") || "").includes("json");
  const shown = json ? JSON.stringify(JSON.parse(text), null, 2) : text;
  into.textContent = `${answer.status} ${answer.statusText}\n\n${shown.slice(0, SHOWN_MAX)}`;
  into.hidden = false;
}

const api = await (await ask("openapi.json")).json();
document.getElementById("source").textContent = api.info.version;
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, about] of Object.entries(methods)) {
    const box = element("section", "", document.getElementById("paths"));
    element("h2", `${method.toUpperCase()} ${path}`, box);
    element("p", about.summary || "", box);
    if (method !== "get") continue; // it would change something
    const button = element("button", "Show the answer", box), into = element("pre", "", box);
    button.type = "button";
    into.hidden = true;
    into.tabIndex = 0;
    button.onclick = () => show(path, into);
  }
}
