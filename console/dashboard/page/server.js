// What the page asks the server, and what the server tells by itself. All addresses are below the page's own.

export class Refused extends Error {
  constructor(status, text) { super(text); this.status = status; }
}

export const session = { role: "", csrf: "", sees_state: false };

async function call(method, address, body) {
  const headers = { "x-holdfast-csrf": session.csrf };
  if (body !== undefined) headers["content-type"] = "application/json";
  let answer;
  try {
    answer = await fetch(address, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), credentials: "same-origin" });
  } catch (error) {
    throw new Refused(0, "The dashboard does not answer: has its program ended?");
  }
  if (answer.status === 204) return null;
  const told = await answer.json().catch(() => ({ text: `The server said ${answer.status}.` }));
  if (!answer.ok) {
    if (answer.status === 401 && address !== "session") window.dispatchEvent(new Event("loggedout"));
    throw new Refused(answer.status, told.text || `The server said ${answer.status}.`);
  }
  return told;
}

export async function whoAmI() {
  const told = await call("GET", "session");
  if (!told.role) { window.dispatchEvent(new Event("loggedout")); throw new Refused(401, ""); }
  Object.assign(session, told);
}
export async function logIn(token) { Object.assign(session, await call("POST", "session", { token })); }
export const logOut = () => call("DELETE", "session");
export const ask = async (question) => (await call("POST", "ask", question)).value;
export const act = (order) => call("POST", "act", order);
export const seek = async (pattern) => (await call("POST", "seek", { pattern })).paths;
export const watch = (viewer, paths) => call("POST", "watch", { viewer, paths });

export const question = (more = {}) => ({ path: "**", kinds: [], limit: 200, ...more });

// A stream of events; it is opened again when it breaks. `on` has a function for each kind.
export function stream(address, on) {
  let source = null, timer = 0, isOver = false;
  const open = () => {
    source = new EventSource(address);
    source.onopen = () => on.open?.();
    for (const kind of ["snapshot", "change", "events", "troubles", "problem", "trace"])
      if (on[kind]) source.addEventListener(kind, (event) => on[kind](JSON.parse(event.data)));
    source.onerror = () => {
      source.close();
      on.broken?.();
      if (!isOver && on.again !== false) timer = setTimeout(open, 1000);
    };
  };
  open();
  return () => { isOver = true; clearTimeout(timer); source.close(); };
}
