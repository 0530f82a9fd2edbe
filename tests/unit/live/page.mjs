// Runs the script of the live page without a browser. Standard input has a JSON list of steps:
// {status}, {frame}, {answer}, {close: true}, {open: true}, {wait_ms} or {click: id}. Standard
// output gets a JSON list: what the page shows after each step, and what it has sent.

import { readFileSync } from "node:fs";
import vm from "node:vm";

const made = new Map();
const timers = [];
const sent = [];
const sockets = [];
let now_ms = 0;

// An element that accepts every call; only its plain values matter.
function element() {
  const values = { dataset: {}, style: {}, handlers: {}, kept: [], attributes: {}, hidden: false, checked: false };
  const calls = {
    append: (...more) => values.kept.push(...more),
    replaceChildren: (...more) => { values.kept = more; values.textContent = more.map((each) => each?.textContent ?? each).join(""); },
    addEventListener: (name, act) => { values.handlers[name] = act; },
    setAttribute: (name, value) => { values.attributes[name] = value; },
    getContext: () => element(),
  };
  return new Proxy(values, {
    set: (_, key, value) => { values[key] = key === "value" ? String(value) : value; return true; },
    get: (_, key) => {
      if (key in values) return values[key];
      if (key in calls) return calls[key];
      if (key === "children") return values.kept;
      if (key === "childElementCount") return values.kept.length;
      if (key === "firstElementChild" || key === "firstChild" || key === "parentElement") return (values[key] = element());
      if (["value", "textContent"].includes(key)) return "";
      if (key === Symbol.toPrimitive) return () => "";
      return () => element();
    },
  });
}

const $ = (id) => {
  if (!made.has(id)) made.set(id, element());
  return made.get(id);
};

class WebSocket {
  static OPEN = 1;
  readyState = 1;
  constructor() { sockets.push(this); }
  send(text) { sent.push(JSON.parse(text)); }
}

const document = {
  getElementById: $, querySelector: $, querySelectorAll: () => [], createElement: element,
  documentElement: element(), title: "",
};
const context = {
  document, WebSocket, URLSearchParams, TextDecoder, console,
  location: { hash: "#token", host: "127.0.0.1:1", search: "" },
  matchMedia: () => ({ matches: false, addEventListener() {} }),
  performance: { now: () => now_ms },
  addEventListener() {}, requestAnimationFrame() {}, setTimeout() {},
  setInterval: (act) => timers.push(act),
  Option: element, ResizeObserver: class { observe() {} },
  open: element,
};
vm.runInContext(readFileSync(process.argv[2], "utf8"), vm.createContext(context));

const steps = JSON.parse(readFileSync(0, "utf8"));
const found = steps.map((step) => {
  const socket = sockets.at(-1);
  if (step.open) socket.onopen();
  if (step.close) socket.onclose();
  if (step.status) socket.onmessage({ data: JSON.stringify({ kind: "status", ...step.status }) });
  if (step.answer) socket.onmessage({ data: JSON.stringify({ kind: "answer", id: sent.at(-1).id, ...step.answer }) });
  if (step.click) $(step.click).handlers.click();
  if (step.wait_ms) { now_ms += step.wait_ms; for (const act of timers) act(); }
  return {
    notice: $("ending").hidden ? "" : $("notice").textContent,
    kind: $("notice").dataset.kind, badge: $("state").textContent, title: document.title,
    stop: $("stop").textContent, main: !$("main").hidden, name: $("name").textContent,
    said: $("said").textContent, frozen: $("freeze").attributes["aria-pressed"] === "true",
  };
});
console.log(JSON.stringify({ found, sent }));
