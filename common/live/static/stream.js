// Reads the looks of a source, with the token if it needs one, and asks again whenever the stream ends.
// The browser's EventSource cannot send a token.

const KEY = "offboard-token";
const RETRY_MS = 1000;
const SHORT_MS = 500; // a stream that ends sooner is not asked for again at once
const SILENT_MS = 5000; // a source sends a look a second: after this the connection is dead

export const authorization = () => {
  const token = sessionStorage.getItem(KEY);
  return token ? { Authorization: `Bearer ${token}` } : {};
};

const pause = ms => new Promise(done => setTimeout(done, ms));

// Shows the form until a token is entered, which is kept until the tab is closed.
export function askToken() {
  const form = document.getElementById("login"), note = document.getElementById("login-note");
  note.textContent = sessionStorage.getItem(KEY) ? "The server refused this token." : "";
  form.hidden = false;
  document.getElementById("token").focus();
  return new Promise(done => {
    form.onsubmit = event => {
      event.preventDefault();
      sessionStorage.setItem(KEY, document.getElementById("token").value.trim());
      form.hidden = true;
      done();
    };
  });
}

async function read(body, alive, onLook) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    alive();
    const parts = (text + value).split("\n\n");
    text = parts.pop();
    for (const part of parts) if (part.startsWith("data: ")) onLook(JSON.parse(part.slice(6)));
  }
}

// Calls onLook with each look, and onState with "live", "token" or "lost" and a text.
export async function follow(url, onLook, onState) {
  for (;;) {
    const begun = performance.now(), stop = new AbortController();
    let timer = setTimeout(() => stop.abort(), SILENT_MS);
    const alive = () => { clearTimeout(timer); timer = setTimeout(() => stop.abort(), SILENT_MS); };
    try {
      const answer = await fetch(url, { headers: authorization(), cache: "no-store", signal: stop.signal });
      if (answer.status === 401) {
        clearTimeout(timer);
        onState("token", "token needed");
        await askToken();
        continue;
      }
      if (!answer.ok) throw new Error(await answer.text());
      onState("live", "live");
      await read(answer.body, alive, onLook);
      if (performance.now() - begun > SHORT_MS) continue; // the server ends each stream after a while
    } catch (error) {
      onState("lost", `no connection since ${new Date().toLocaleTimeString([], { hourCycle: "h23" })}; trying again each second`);
    } finally {
      clearTimeout(timer);
    }
    await pause(RETRY_MS);
  }
}

// A report has in its own file what the page loads elsewhere: text, packed with gzip and base64; null if it is not there.
export async function unpacked(id) {
  const packed = document.getElementById(id);
  if (packed === null) return null;
  const bytes = Uint8Array.from(atob(packed.textContent), one => one.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}

// Runs a script. The page's policy allows no other way to run a text.
export function run(text) {
  return new Promise((done, failed) => document.head.append(Object.assign(document.createElement("script"), {
    src: URL.createObjectURL(new Blob([text], { type: "text/javascript" })), onload: done, onerror: failed,
  })));
}
