// The live page: draws the data of the server and sends the user's requests. It has no state, so a
// reload or a second page does not affect the run.

const PROTOCOL = "hilctl.live.1";
const WINDOWS_S = [0.02, 0.1, 0.5, 2, 10, 60, 600];
const FIGURES = [
  ["peak_hysteresis_percent", "peak hysteresis", "%", 2],
  ["noise_floor_percent", "noise floor", "%", 2],
  ["peak_error_percent", "peak error", "%", 2],
  ["rms_error_percent", "rms error", "%", 2],
  ["peak_error_um", "peak error, single samples", "µm", 3],
  ["rms_error_um", "rms error, single samples", "µm", 3],
  ["peak_to_peak_um", "stroke", "µm", 2],
  ["sensor_noise_um", "sensor noise", "µm", 4],
];
const FRESH_MS = 2000;
const SHRINK_MS = 3000;
const HALF_A_PIXEL = 0.5;

const $ = (id) => document.getElementById(id);
const token = location.hash.slice(1);
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const view = { run: new URLSearchParams(location.search).get("run"), axis: null, mode: "cycle", window_s: 2, across: "", up: "", path_s: 0.5 };
const scope = { trigger: "cycle", frozen: false, zoom: null, at: null, anchor: null, hidden: new Set(), ranges: new Map() };
let socket = null;
let status = null;
let live = false; // whether the status is a present one
let saidMs = 0;
let noReport = "";
let frame = null;
let shown = null; // what the scope shows
let drawn = 0;
let lastFrameMs = 0;
let nextId = 1;
const waiting = new Map();

// ---- connection

function connect() {
  if (!token) {
    notice("This address has no token: open the address that hilctl printed.");
    return;
  }
  socket = new WebSocket(`ws://${location.host}/live`, [PROTOCOL, `token.${token}`]);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => ask("view", { view });
  socket.onmessage = (message) => {
    if (typeof message.data === "string") said(JSON.parse(message.data));
    else frame = message.data;
  };
  socket.onclose = () => {
    socket = null;
    for (const [id] of waiting) answered({ id, ok: false, error: "the server of the page has ended" });
    lost("no connection");
    setTimeout(connect, 1000);
  };
}

// The last status does not describe the present: another run may be active.
function lost(what) {
  live = false;
  badge("lost", what);
  if (status?.ended) showEnd();
  else notice(`No status from the server of the page (${what}). The run may still be active: stop it with hilctl stop.`);
}

function element(tag, content = [], more = {}) {
  const made = Object.assign(document.createElement(tag), more);
  made.append(...[content].flat());
  return made;
}

function ask(what, more, then = () => {}) {
  const id = nextId++;
  waiting.set(id, then);
  if (socket === null || socket.readyState !== WebSocket.OPEN) {
    answered({ id, ok: false, error: "no connection to the server of the page" });
  } else {
    socket.send(JSON.stringify({ id, ask: what, ...more }));
  }
}

function answered(answer) {
  const then = waiting.get(answer.id);
  waiting.delete(answer.id);
  if (then) then(answer);
}

function said(message) {
  if (message.kind === "answer") { answered(message); return; }
  if (status?.run !== message.run) forget();
  else if (!live) notice("");
  if (status?.axis !== message.axis) forgetAxis();
  [status, live, saidMs] = [message, true, performance.now()];
  showStatus();
}

// Nothing of one run is shown beside another.
function forget() {
  notice("");
  say("");
  $("stop").replaceChildren("STOP ", element("kbd", "Esc"));
  noReport = "";
  forgetAxis();
}

function forgetAxis() {
  for (const id of ["gain", "offset"]) delete $(id).dataset.touched;
  if (scope.frozen) freeze();
  frame = shown = scope.zoom = scope.anchor = null;
}

// ---- text and numbers

function notice(text, kind = "bad") {
  $("ending").hidden = !text;
  $("notice").textContent = text;
  $("notice").dataset.kind = kind;
}

function badge(kind, text) {
  $("state").dataset.kind = kind;
  $("state").textContent = text;
  document.title = status?.run ? `${text} · ${status.run}` : "hilctl";
}

function say(text, kind = "good") {
  $("said").textContent = text;
  $("said").dataset.kind = kind;
}

function number(value, decimals, width = 8) {
  const text = value === null || value === undefined ? "–" : value.toFixed(decimals);
  return text.padStart(width, "\u2007");
}

function time(seconds) {
  const minutes = Math.floor(seconds / 60);
  return `${String(minutes).padStart(2, "0")}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

function bytes(count) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let at = 0;
  for (; count >= 1000 && at < units.length - 1; at += 1) count /= 1000;
  return `${count.toPrecision(3)} ${units[at]}`;
}

function unit(kind) {
  return { um: "µm", command: status.description.command_unit }[kind] ?? kind;
}

function showStatus() {
  showRuns();
  showAxes();
  const { description } = status;
  for (const part of ["main", "footer"]) document.querySelector(part).hidden = !description;
  $("stop").disabled = Boolean(status.ended);
  if (!description) {
    badge("lost", "no active run");
    $("name").textContent = "hilctl";
    $("clock").textContent = $("segment").textContent = "";
    $("done").value = 0;
    return;
  }
  $("name").textContent = description.name;
  badge(status.state, status.state);
  $("clock").textContent = `${time(status.t_s)} of ${time(status.total_s)}`;
  $("segment").textContent = status.segment;
  $("done").value = Math.min(1, status.t_s / status.total_s);
  $("recording").textContent = `recording: ${status.recording}`;
  const disk = status.disk
    ? `${bytes(status.disk.recorded_bytes)} recorded, ${bytes(status.disk.free_bytes)} free on disk · ` : "";
  $("room").textContent = `${disk}ring ${(100 * status.ring_used).toFixed(0)} % full · `
    + `${status.missed_samples} samples not shown`;
  $("report").hidden = !status.ended;
  if (status.ended) showEnd();
  showFigures();
  showGauges();
  showControls();
  showEvents();
  showKeys();
  drawSmall();
}

function showEnd() {
  const others = status.runs.map((run) => run.name).filter((name) => name !== status.run).join(", ");
  const later = live ? others && ` Active now: ${others}.` : " The page has no connection since then, and shows no later run.";
  const kind = later && endKind() === "good" ? "calm" : endKind();
  notice(`${status.run} ended: ${status.reason || status.state}${safeText()}${later}${noReport}`, kind);
}

function endKind() {
  if (status.state === "completed" && status.safe) return "good";
  return status.state === "stopped" && status.safe ? "calm" : "bad";
}

function safeText() {
  if (status.safe === null) return "";
  return status.safe ? ". Its output was then at its safe value, confirmed." : ". Its output was NOT known to be safe: look at it.";
}

function showRuns() {
  const names = status.runs.map((run) => run.name);
  const key = [status.run, ...names].join();
  if ($("runs").dataset.key === key) return;
  $("runs").dataset.key = key;
  $("runs").replaceChildren(...names.filter(() => names.length > 1).map((name) => {
    const link = element("a", name, { href: `/?run=${encodeURIComponent(name)}#${token}`, target: "_blank" });
    if (name === status.run) link.setAttribute("aria-current", "page");
    return link;
  }));
}

function showAxes() {
  const { axis, axes = [] } = status;
  const key = [status.run, axis, ...axes].join();
  if ($("axes").dataset.key === key) return;
  $("axes").dataset.key = key;
  $("axes").replaceChildren(...axes.map((name) => {
    const button = element("button", name, { type: "button", ariaPressed: String(name === axis) });
    button.addEventListener("click", () => { view.axis = name; ask("view", { view }); });
    return button;
  }));
  $("path").hidden = axes.length === 0;
  $("all-axes").hidden = !choosesAxis();
  if (axes.length ? axes.includes(view.across) && axes.includes(view.up) : !view.across) return;
  [view.across, view.up] = axes.length ? axes : ["", ""];
  for (const end of ["across", "up"]) $(`path-${end}`).replaceChildren(...axes.map((name) => new Option(name, name, false, name === view[end])));
  setPath();
}

function setPath() {
  ranges.delete("path-x");
  ranges.delete("path-y");
  ask("view", { view });
}

function showFigures() {
  const tiles = $("tiles");
  const shownFigures = [...FIGURES, ...status.aux.map(({ name, unit: what }) => [name, name, what, 2])];
  const values = { ...status.figures, ...Object.fromEntries(status.aux.map(({ name, value }) => [name, value])) };
  if (tiles.childElementCount !== shownFigures.length) {
    tiles.replaceChildren(...shownFigures.map(([key, label]) => (
      element("div", [element("dt", label), element("dd", [], { id: `figure-${key}` })]))));
  }
  for (const [key, , what, decimals] of shownFigures) {
    $(`figure-${key}`).replaceChildren(number(values[key], decimals), element("small", ` ${what}`));
    $(`figure-${key}`).parentElement.hidden = key.includes("error") && status.description.waveform_unit !== "um";
  }
  $("peak").hidden = status.description.waveform_unit !== "um";
  $("peak-text").textContent = `peak error since ${time(status.peak_error.since_s)}: ${number(status.peak_error.um, 3, 7)} µm`;
}

function showGauges() {
  const list = status.gauges;
  const box = $("gauges");
  const names = list.map((gauge) => gauge.name);
  if (box.dataset.names !== names.join()) {
    box.dataset.names = names.join();
    const num = { className: "num" };
    box.replaceChildren(...names.map((name) => element("div", [
      element("span", name), element("i", element("b")), element("span", [], num), element("small", [], num),
    ], { className: "gauge" })));
  }
  list.forEach((gauge, at) => {
    const [, bar, part, text] = box.children[at].children;
    box.children[at].dataset.kind = gauge.level;
    bar.firstChild.style.width = `${Math.min(100, 100 * gauge.used)}%`;
    part.textContent = `${number(100 * gauge.used, 1, 6)} %`;
    text.textContent = `${Number(gauge.value.toPrecision(3))} of ${Number(gauge.limit.toPrecision(4))} ${gauge.unit.replace("um", "µm")}`;
  });
}

function showControls() {
  const runs = ["running", "waiting"].includes(status.state);
  for (const field of ["gain", "offset"]) {
    const input = $(field);
    if (document.activeElement !== input && !input.dataset.touched) input.value = status[field];
  }
  $("offset-unit").textContent = status.description.waveform_unit.replace("um", "µm");
  showChange();
  $("inverse-row").hidden = !status.description.compensator;
  $("inverse-in").setAttribute("aria-pressed", String(status.inverse === "in"));
  $("inverse-out").setAttribute("aria-pressed", String(status.inverse === "out"));
  for (const control of document.querySelectorAll("#controls button")) control.disabled = !runs;
}

function showEvents() {
  const log = $("log");
  const key = `${status.events.length} ${status.events.at(-1)?.t_s} ${status.events.at(-1)?.text}`;
  if (log.dataset.key === key) return;
  log.dataset.key = key;
  log.replaceChildren(...status.events.toReversed().map((event) => {
    const line = element("li", [element("span", time(event.t_s), { className: "num" }), element("span", `${event.code}: ${event.text}`)]);
    line.dataset.kind = event.level;
    return line;
  }));
}

function showKeys() {
  const body = $("keys");
  const now = [["gain", String(status.gain)], ["offset", String(status.offset)]];
  if (status.description.compensator) now.push(["inverse", status.inverse ?? "in"]);
  const rows = [
    ...now.map(([key, value]) => [key, value, "now"]),
    ["mark", "", "now"],
    ...status.description.settings.map((row) => [
      row.key, row.value, row.settable ? `next run: --set ${row.key}=…` : "only in the file"]),
  ];
  const key = JSON.stringify(rows);
  if (body.dataset.key === key) return;
  body.dataset.key = key;
  // Long keys break after a dot, not within a word.
  const parts = (text) => text.split(/(?<=\.)/).flatMap((part) => [part, element("wbr")]);
  body.replaceChildren(...rows.map(([name, value, when]) => element("tr", [parts(name), value, parts(when)].map((text) => element("td", text)))));
}

// ---- plots

// Read once per theme: reading the style in each frame costs as much as drawing.
const colours = new Map();
function colour(name) {
  if (!colours.has(name)) {
    colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  }
  return colours.get(name);
}
let letter = 16;
const ranges = new Map();

// A range grows immediately and shrinks later, in steps: jumping axes are unreadable.
function steady(name, low, high) {
  if (!(low <= high)) { low = -1; high = 1; }
  const now = performance.now();
  const spare = 0.06 * (high - low) || 0.5 * Math.abs(high) || 1;
  const wanted = [low - spare, high + spare];
  const had = ranges.get(name);
  if (!had) {
    ranges.set(name, { range: wanted, small: now });
    return wanted;
  }
  const [a, b] = had.range;
  if (low < a || high > b) {
    had.range = [Math.min(a, wanted[0]), Math.max(b, wanted[1])];
    had.small = now;
  } else if (high - low > 0.6 * (b - a)) {
    had.small = now;
  } else if (now - had.small > SHRINK_MS) {
    had.range = wanted;
    had.small = now;
  }
  return had.range;
}

// One pixel wide if that is visible: wider lines of a thousand points take twice the time.
function series(label, stroke, more = {}) {
  return { label, stroke, width: letter < 18 ? 1 : 0.1 * letter, points: { show: false }, ...more };
}

// A logarithmic axis has lines at powers of ten only: nine per decade would hide the curve.
function decades(plot, splits, axis) {
  if (plot.scales[plot.axes[axis].scale].distr !== 3) return splits;
  return splits.map((each) => (Number.isInteger(Number(Math.log10(each).toFixed(6))) ? each : null));
}

function axes(yLabel, xLabel, more = {}) {
  const look = { stroke: colour("quiet"), grid: { stroke: colour("line"), width: 1, filter: decades }, ticks: { stroke: colour("line"), filter: decades } };
  const size = letter;
  const font = `${Math.round(0.8 * size)}px system-ui, sans-serif`;
  return [
    { ...look, font, label: xLabel, labelFont: font, labelSize: 1.3 * size, size: 1.9 * size, space: 5 * size, ...more },
    { ...look, font, label: yLabel, labelFont: font, labelSize: 1.4 * size, size: 4.2 * size,
      space: (plot, axis, low, high, height) => Math.min(2 * size, 0.2 * height) },
  ];
}

let plots = {};

function build() {
  for (const each of Object.values(plots)) each.plot.destroy();
  ranges.clear();
  colours.clear();
  letter = parseFloat(getComputedStyle(document.documentElement).fontSize);
  plots = {};
  const command = status.description.command_unit;
  const dash = { dash: [6, 4] };
  const measured = status.description.measures_command;
  const follows = status.description.waveform_unit === "um"; // otherwise there is no error
  add("plot-um", [...(follows ? [["reference", series("reference", colour("reference"), dash)]] : []),
    ["displacement", series("displacement", colour("displacement"))]], "displacement, µm");
  for (const id of ["plot-error", "spectrum"]) $(id).hidden = !follows;
  if (follows) add("plot-error", [["error", series("error", colour("error"))]], "error, µm");
  add("plot-command", [["command", series("command", colour("command"))],
    ...(measured ? [["measured", series("measured", colour("measured"), dash)]] : [])], `command, ${command}`, status.description.aux.length ? "" : "time, s");
  addAux();
  const chosen = $("level-signal").value || "displacement";
  $("level-signal").replaceChildren(...scopePlots().flatMap(({ signals }) => signals).map((name) => new Option(name, name, false, name === chosen)));
  showKey();
  showRanges();
  const log = { distr: 3 };
  if (follows) small("plot-spectrum", [{}, series("error", colour("error"))], { x: { time: false, ...log }, y: { ...log, range: spectrumRange } },
    axes("amplitude, µm", "frequency, Hz"));
  small("plot-late", [{}, series("ticks", colour("bar"), { fill: `${colour("bar")}55`, paths: uPlot.paths.stepped({ align: 1 }) })],
    { x: { time: false, ...log }, y: { range: (_, low, high) => [0, Math.max(1, high * 1.1)] } }, axes("ticks", "late by, µs"));
}

// One plot per unit.
function addAux() {
  const { aux } = status.description;
  const units = [...new Set(aux.map((each) => each.unit))];
  $("plots-aux").replaceChildren(...units.map((what) => element("div", [], { className: "plot", id: `plot-aux-${what}` })));
  const inks = ["displacement", "command", "error", "reference"];
  for (const what of units) {
    const lines = aux.filter((each) => each.unit === what).map(({ name }, at) => [name, series(name, colour(inks[at % inks.length]))]);
    add(`plot-aux-${what}`, lines, what ? `auxiliary, ${what}` : "auxiliary", what === units.at(-1) ? "time, s" : "");
  }
}

function spectrumRange(_, low, high) {
  const top = 10 ** Math.ceil(Math.log10(Math.max(high || 1, 1e-9)));
  return [top * 1e-5, top];
}

function sizes(box) {
  // Without the legend, which stands below the plot.
  return { width: box.clientWidth, height: Math.max(60, box.clientHeight - (box.dataset.legend ? 26 : 0)) };
}

function add(id, signals, yLabel, xLabel = "") {
  const box = $(id);
  const options = {
    ...sizes(box), legend: { show: false },
    cursor: { drag: { x: true, y: false, setScale: false }, sync: { key: "scope" }, points: { show: false } },
    hooks: { setCursor: [readOut], setSelect: [zoomIn], draw: [drawAnchor] },
    scales: {
      x: { time: false, range: (_, low, high) => scope.zoom ?? [low, high] },
      y: { range: (_, low, high) => scope.ranges.get(id) ?? steady(id, low, high) },
    },
    // By their own digits: the default rounds 0.0025 to 0.003.
    axes: axes(yLabel, xLabel).map((axis) => ({ ...axis, values: (_, splits) => splits.map(tidy) })), series: [{}, ...signals.map(([, each]) => each)],
  };
  for (const each of options.series.slice(1)) each.show = !scope.hidden.has(each.label);
  const plot = new uPlot(options, [[0, 1], ...signals.map(() => [null, null])], box);
  plot.over.addEventListener("click", () => { if (scope.at !== null) setAnchor(scope.anchor ? null : shown.t[scope.at]); });
  plot.over.addEventListener("dblclick", () => { scope.zoom = null; setAnchor(null); });
  plots[id] = { plot, signals: signals.map(([name]) => name) };
}

function small(id, lines, scales, axis) {
  const box = $(id);
  const options = { ...sizes(box), legend: { show: false }, cursor: { drag: { x: false, y: false } }, scales, axes: axis, series: lines,
    padding: [null, 2 * letter, null, null] }; // for the last number of the axis
  for (const each of options.axes) each.values = (_, splits) => splits.map((value) => (value === null ? "" : tidy(value)));
  plots[id] = { plot: new uPlot(options, [[1, 10], [1, 1]], box) };
}

function drawSmall() {
  if (!plots["plot-late"]) return;
  const edges = status.lateness_edges_us;
  const counts = status.lateness_counts;
  let first = counts.findIndex((count) => count > 0);
  if (first < 0) first = 1;
  let last = counts.length - 1;
  while (last > first && counts[last] === 0) last -= 1;
  first = Math.max(1, first - 1);
  last = Math.min(counts.length - 1, last + 1);
  plots["plot-late"].plot.setData([edges.slice(first, last + 1), counts.slice(first, last + 1)]);
  const late = status.lateness_us;
  $("late-text").textContent = `p50 ${number(late.p50, 0, 4)} · p99 ${number(late.p99, 0, 5)} · max ${number(late.max, 0, 5)} µs · ${status.late_ticks} late`;
  if (plots["plot-spectrum"] && status.spectrum.hz.length) {
    plots["plot-spectrum"].plot.setData([status.spectrum.hz, status.spectrum.um.map((um) => Math.max(um, 1e-12))]);
  }
}

function unpack(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  const values = new Float32Array(buffer, 4 + size);
  const { n, signals, loop, path } = header;
  const rows = (start) => Array.from({ length: signals }, (_, row) => values.subarray(start + row * n, start + (row + 1) * n));
  const end = n + 2 * signals * n;
  return { ...header, t: values.subarray(0, n), low: rows(n), high: rows(n + signals * n),
    input: values.subarray(end, end + loop), output: values.subarray(end + loop, end + 2 * loop),
    paths: Array.from({ length: 4 }, (_, row) => values.subarray(end + 2 * loop + row * path, end + 2 * loop + (row + 1) * path)) };
}

// Each bucket is two points, its minimum and maximum, in the order of the slope (otherwise a smooth
// signal would look like a sawtooth). If both coincide, the second is undefined and skipped, because
// the number of points determines the cost.
function line(low, high, still) {
  const found = new Array(2 * low.length);
  let before = NaN;
  for (let at = 0; at < low.length; at += 1) {
    const a = low[at];
    const b = high[at];
    if (Number.isNaN(a)) {
      found[2 * at] = found[2 * at + 1] = null;
      continue;
    }
    const falls = a + b < before;
    found[2 * at] = falls ? b : a;
    if (b - a > still) found[2 * at + 1] = falls ? a : b;
    before = a + b;
  }
  return found;
}

function draw(data) {
  drawLoops(data);
  if (data.path) drawPath(data.paths);
  drawScope(scope.trigger === "level" ? fromCrossing(data) : data);
}

// Half a window, from the newest crossing of the level that has half a window after it.
function fromCrossing(data) {
  const row = rowOf($("level-signal").value), level = typed("level-value"), edge = Number($("level-edge").value);
  const half = data.n >> 1;
  const above = (at) => edge * (0.5 * (data.low[row][at] + data.high[row][at]) - level) >= 0;
  const below = (at) => edge * (0.5 * (data.low[row][at] + data.high[row][at]) - level) < 0;
  let at = data.n - half;
  while (at > 0 && !(above(at) && below(at - 1))) at -= 1;
  $("level-state").textContent = at ? "" : "no crossing in the window";
  if (!at && shown) return shown;
  const part = (values) => values.subarray(at, at + half);
  return { ...data, n: half, t: part(data.t).map((t) => t - data.t[at]), low: data.low.map(part), high: data.high.map(part) };
}

function rowOf(name) {
  return status.signals.findIndex(([each]) => each === name);
}

function drawScope(data) {
  shown = data;
  const times = new Array(2 * data.n);
  const half = 0.5 * (data.t[1] - data.t[0]);
  for (let at = 0; at < data.n; at += 1) { times[2 * at] = data.t[at]; times[2 * at + 1] = data.t[at] + half; }
  for (const { plot, signals } of scopePlots()) {
    const { min, max } = plot.scales.y;
    const still = (HALF_A_PIXEL * (max - min)) / plot.bbox.height;
    plot.setData([times, ...signals.map((name) => {
      const row = rowOf(name);
      return line(data.low[row], data.high[row], still);
    })]);
  }
  $("window").disabled = data.mode === "cycle";
  readOut();
}

// ---- tools of the scope

function scopePlots() {
  return Object.values(plots).filter(({ signals }) => signals);
}

function redraw() {
  if (shown) drawScope(shown);
}

function showKey() {
  $("key").replaceChildren(...scopePlots().flatMap(({ plot }) => plot.series.slice(1).map((each, at) => {
    const sample = element("i");
    sample.style.borderTop = `${each.dash ? "dashed" : "solid"} 2px ${each.stroke()}`;
    const name = element("button", [sample, each.label], { type: "button", ariaPressed: String(each.show) });
    name.addEventListener("click", () => {
      scope.hidden[each.show ? "add" : "delete"](each.label);
      plot.setSeries(at + 1, { show: !each.show });
      name.setAttribute("aria-pressed", String(each.show));
    });
    return name;
  })));
}

// Two fields per plot; without a number the range follows the signals.
function showRanges() {
  const open = $("ranges").firstElementChild;
  $("ranges").replaceChildren(open, ...Object.keys(plots).filter((id) => plots[id].signals).map((id) => {
    const { label } = plots[id].plot.axes[1];
    const ends = ["low", "high"].map((end, at) => element("input", [], {
      inputMode: "decimal", id: `${id}-${end}`, placeholder: "automatic", ariaLabel: `${label}: ${end} end`,
      value: scope.ranges.get(id)?.[at] ?? "", onchange: () => setRange(id),
    }));
    return element("div", [element("span", label), ...ends], { className: "row" });
  }));
}

function setRange(id) {
  const [low, high] = ["low", "high"].map((end) => ($(`${id}-${end}`).value.trim() ? typed(`${id}-${end}`) : NaN));
  if (low < high) scope.ranges.set(id, [low, high]);
  else scope.ranges.delete(id);
  redraw();
}

function zoomIn(plot) {
  if (plot.select.width < 4) return;
  const { left, width } = plot.select;
  scope.zoom = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
  plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
  redraw();
}

function setAnchor(t) {
  scope.anchor = t === null ? null : { t, values: shown.low.map((low, row) => 0.5 * (low[scope.at] + shown.high[row][scope.at])) };
  redraw();
}

function drawAnchor(plot) {
  if (scope.anchor === null) return;
  const x = plot.valToPos(scope.anchor.t, "x", true);
  const pen = plot.ctx;
  pen.save();
  pen.strokeStyle = colour("ink");
  pen.setLineDash([2, 3]);
  stroke(pen, [[x, plot.bbox.top], [x, plot.bbox.top + plot.bbox.height]]);
  pen.restore();
}

// Values at the cursor, and from the reference cursor to it.
function readOut(plot) {
  if (plot) scope.at = plot.cursor.idx === null || plot.cursor.idx === undefined ? null : plot.cursor.idx >> 1;
  const at = scope.at;
  if (at === null || !shown || at >= shown.n) return;
  const { anchor } = scope;
  const parts = [`t ${tidy(shown.t[at])} s`];
  const dt = anchor && shown.t[at] - anchor.t;
  if (dt) parts.push(`Δt ${tidy(dt)} s (${tidy(1 / Math.abs(dt))} Hz)`);
  for (const { plot: each, signals } of scopePlots()) {
    signals.forEach((name, line) => {
      const row = rowOf(name), low = shown.low[row][at], high = shown.high[row][at];
      if (!each.series[line + 1].show || Number.isNaN(low)) return;
      const what = unit(status.signals[row][2]);
      const range = short(low) === short(high) ? short(low) : `${short(low)} to ${short(high)}`;
      const moved = dt ? ` (Δ ${short(0.5 * (low + high) - anchor.values[row])})` : "";
      parts.push(`${name} ${range}${moved} ${what}`);
    });
  }
  $("readout").textContent = parts.join("   ");
}

function short(value) {
  return String(Number(value.toPrecision(4)));
}

function freeze() {
  scope.frozen = !scope.frozen;
  $("freeze").setAttribute("aria-pressed", String(scope.frozen));
}

function save(blob, kind) {
  const download = `${status.run}-${time(status.t_s).replace(":", "m")}s.${kind}`;
  const link = element("a", [], { href: URL.createObjectURL(blob), download });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// The buckets of the window: the smallest and the largest value of each signal.
function saveCsv() {
  const used = scopePlots().flatMap(({ signals }) => signals).map((name) => [name, rowOf(name)]);
  const names = used.flatMap(([name, row]) => ["min", "max"].map((end) => `${name}_${unit(status.signals[row][2]).replace("µ", "u").toLowerCase()}_${end}`));
  const lines = Array.from({ length: shown.n }, (_, at) => [shown.t[at], ...used.flatMap(([, row]) => [shown.low[row][at], shown.high[row][at]])]
    .map((value) => (Number.isNaN(value) ? "" : Number(value.toPrecision(7)))).join());
  save(new Blob([`${["t_s", ...names].join()}\n${lines.join("\n")}\n`], { type: "text/csv" }), "csv");
}

function savePng() {
  const parts = scopePlots().map(({ plot }) => plot.ctx.canvas);
  const page = document.createElement("canvas");
  const head = 2.4 * letter * devicePixelRatio;
  page.width = Math.max(...parts.map((each) => each.width));
  page.height = head + parts.reduce((sum, each) => sum + each.height, 0);
  const pen = page.getContext("2d");
  pen.fillStyle = colour("card");
  pen.fillRect(0, 0, page.width, page.height);
  pen.font = `${letter * devicePixelRatio}px system-ui, sans-serif`;
  pen.fillStyle = colour("ink");
  let x = 0.6 * head;
  const write = (text, style) => { pen.fillStyle = style; pen.fillText(text, x, 0.65 * head); x += pen.measureText(text).width + 0.5 * head; };
  write(`${status.run}, ${time(status.t_s)}`, colour("ink"));
  for (const { plot } of scopePlots()) for (const each of plot.series.slice(1)) if (each.show) write(each.label, each.stroke());
  let y = head;
  for (const each of parts) { pen.drawImage(each, 0, y); y += each.height; }
  page.toBlob((blob) => save(blob, "png"));
}

// ---- loops

function drawLoops(data) {
  const inputUnit = status.description.waveform_unit === "um" ? "reference, µm" : `command, ${status.description.command_unit}`;
  let lowest = Infinity, highest = -Infinity, atLowest = 0, atHighest = 0, least = Infinity, most = -Infinity;
  for (let at = 0; at < data.loop; at += 1) {
    const x = data.input[at], y = data.output[at];
    if (Number.isNaN(x) || Number.isNaN(y)) continue;
    if (x < lowest) { lowest = x; atLowest = y; }
    if (x > highest) { highest = x; atHighest = y; }
    least = Math.min(least, y);
    most = Math.max(most, y);
  }
  const slope = highest > lowest ? (atHighest - atLowest) / (highest - lowest) : 0;
  const straight = (x) => atLowest + slope * (x - lowest);
  const across = steady("loop-x", lowest, highest);
  curve($("loop"), data, (_, y) => y, across, steady("loop-y", least, most), inputUnit, "displacement, µm", straight);
  let low = Infinity, high = -Infinity;
  for (let at = 0; at < data.loop; at += 1) {
    const off = data.output[at] - straight(data.input[at]);
    if (off < low) low = off;
    if (off > high) high = off;
  }
  curve($("off"), data, (x, y) => y - straight(x), across, steady("off-y", low, high), inputUnit, "µm", () => 0);
}

// Reference and displacement of two axes, one µm as long across as up.
function drawPath([acrossReference, across, upReference, up]) {
  const range = (name, ...rows) => {
    let low = Infinity, high = -Infinity;
    for (const row of rows) for (const value of row) { if (value < low) low = value; if (value > high) high = value; }
    return steady(name, low, high);
  };
  const { pen, toX, toY, ratio } = grid($("path-plot"), range("path-x", acrossReference, across), range("path-y", upReference, up),
    `${view.across}, µm`, `${view.up}, µm`, true);
  const points = (x, y) => Array.from(x, (value, at) => [toX(value), toY(y[at])]).filter(([a, b]) => !Number.isNaN(a + b));
  pen.strokeStyle = colour("displacement");
  pen.lineWidth = Math.max(1.6, 0.11 * letter) * ratio;
  stroke(pen, points(across, up));
  pen.setLineDash([6 * ratio, 4 * ratio]);
  pen.lineWidth = ratio;
  pen.strokeStyle = colour("reference");
  stroke(pen, points(acrossReference, upReference));
  pen.restore();
}

// Clears a canvas, draws the grid of two ranges, and clips to it until pen.restore().
function grid(canvas, across, up, xLabel, yLabel, equal = false) {
  const ratio = devicePixelRatio;
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const pen = canvas.getContext("2d");
  const size = letter * ratio;
  const left = 4.2 * size, bottom = 2.7 * size, top = 0.4 * size, right = 0.6 * size;
  if (equal) {
    const [wide, high] = [width - left - right, height - bottom - top];
    const scale = Math.max((across[1] - across[0]) / wide, (up[1] - up[0]) / high);
    [across, up] = [[across, wide], [up, high]].map(([[a, b], pixels]) => [(a + b - scale * pixels) / 2, (a + b + scale * pixels) / 2]);
  }
  const toX = (x) => left + (x - across[0]) / (across[1] - across[0]) * (width - left - right);
  const toY = (y) => height - bottom - (y - up[0]) / (up[1] - up[0]) * (height - bottom - top);
  pen.clearRect(0, 0, width, height);
  pen.font = `${0.8 * size}px system-ui, sans-serif`;
  pen.lineWidth = ratio;
  pen.strokeStyle = colour("line");
  pen.fillStyle = colour("quiet");
  pen.textAlign = "center";
  for (const x of marks(across, 5)) { stroke(pen, [[toX(x), top], [toX(x), height - bottom]]); pen.fillText(tidy(x), toX(x), height - 1.6 * size); }
  pen.fillText(xLabel, left + (width - left - right) / 2, height - 0.3 * size);
  pen.textAlign = "right";
  for (const y of marks(up, height / size / 4)) { stroke(pen, [[left, toY(y)], [width - right, toY(y)]]); pen.fillText(tidy(y), left - 0.4 * size, toY(y) + 0.3 * size); }
  pen.save();
  pen.translate(0.9 * size, top + (height - bottom - top) / 2);
  pen.rotate(-Math.PI / 2);
  pen.textAlign = "center";
  pen.fillText(yLabel, 0, 0);
  pen.restore();
  pen.save();
  pen.beginPath();
  pen.rect(left, top, width - left - right, height - bottom - top);
  pen.clip();
  return { pen, toX, toY, ratio };
}

function curve(canvas, data, value, across, up, xLabel, yLabel, straight) {
  const { pen, toX, toY, ratio } = grid(canvas, across, up, xLabel, yLabel);
  pen.setLineDash([6 * ratio, 4 * ratio]);
  pen.strokeStyle = colour("reference");
  stroke(pen, [[toX(across[0]), toY(straight(across[0]))], [toX(across[1]), toY(straight(across[1]))]]);
  pen.setLineDash([]);
  pen.strokeStyle = colour("displacement");
  const cycles = Math.ceil(data.loop / data.cycle);
  for (let cycle = cycles - 1; cycle >= 0; cycle -= 1) {
    pen.globalAlpha = Math.max(0.12, 0.62 ** cycle);
    // Those that fade are thin: a line of one pixel takes a fraction of the time.
    pen.lineWidth = (cycle === 0 ? Math.max(1.6, 0.11 * letter) : 1) * ratio;
    const end = data.loop - cycle * data.cycle;
    const points = [];
    for (let at = Math.max(0, end - data.cycle - 1); at < end; at += 1) {
      const x = data.input[at], y = data.output[at];
      if (!Number.isNaN(x + y)) points.push([toX(x), toY(value(x, y))]);
    }
    stroke(pen, points);
  }
  pen.restore();
}

function stroke(pen, points) {
  pen.beginPath();
  points.forEach(([x, y], at) => (at ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.stroke();
}

function marks([low, high], count) {
  const raw = (high - low) / Math.max(2, count);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= raw);
  const found = [];
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) found.push(value);
  return found;
}

function tidy(value) {
  return String(Number(value.toPrecision(6)));
}

// ---- controls

function stop() {
  $("stop").textContent = "STOP …";
  notice("STOP requested, not yet acknowledged.");
  ask("stop", {}, (answer) => {
    $("stop").textContent = "STOP";
    if (answer.ok && answer.run !== status?.run) return;
    if (answer.ok) $("stop").textContent = "STOP ✓";
    if (answer.ok) notice(`STOP acknowledged: ${answer.run} ${answer.requested ? "ramps to its safe value" : "has already ended"}.`, "calm");
    else notice(`STOP is NOT acknowledged: ${answer.error}. Use hilctl stop or the emergency switch of the rig.`);
  });
}

function report() {
  const tab = open("", "_blank"); // now: browsers block a tab that is opened later
  const { run } = status;
  $("report").disabled = true;
  ask("report", { run }, (answer) => {
    $("report").disabled = false;
    if (answer.ok) { tab.location = answer.path; return; }
    tab.close();
    noReport = ` No report of ${run}: ${answer.error}`;
    notice(noReport);
  });
}

// "0,5" and "0.5" are the same number; anything else is marked as invalid.
function typed(id) {
  const text = $(id).value.trim().replace(",", ".");
  const value = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(text) && Number.isFinite(Number(text)) ? Number(text) : NaN;
  $(id).setCustomValidity(Number.isNaN(value) ? "a number such as 0.5 or 0,5" : "");
  return value;
}

// What "set" will send, before it is sent.
function showChange() {
  if (!status?.description) return;
  const { waveform_unit: what } = status.description;
  const parts = ["gain", "offset"].map((id) => [id, status[id], typed(id)]).filter(([, now, then]) => now !== then)
    .map(([id, now, then]) => `${id} ${now} → ${Number.isNaN(then) ? "not a number" : then}${id === "offset" ? ` ${what.replace("um", "µm")}` : ""}`);
  const over_s = typed("over");
  $("change").textContent = parts.length ? `${parts.join(", ")}, over ${Number.isNaN(over_s) ? "not a number" : over_s} s` : "";
}

function request(command, what) {
  const run = status?.run;
  say(`${what} …`);
  ask("run", { run, request: command }, (answer) => {
    if (run !== status?.run) return;
    say(answer.ok ? `${what}: done` : `${what}: ${answer.error}`, answer.ok ? "good" : "bad");
    if (answer.ok) for (const id of ["gain", "offset"]) delete $(id).dataset.touched;
  });
}

// Whether the axis that is shown can be changed alone.
function choosesAxis() {
  return Boolean(status.axis) && !status.description.coupled;
}

// A change of the axis that is shown, or of all axes.
function change(values, what) {
  const own = choosesAxis() && !$("all").checked;
  request({ command: "set", ...(own ? { axes: { [status.axis]: values } } : values), over_s: typed("over") }, own ? `${status.axis}: ${what}` : what);
}

function inverse(place) {
  typed("over");
  if ($("over").reportValidity()) change({ inverse: place }, `inverse ${place}`);
}

function setTrigger(name) {
  $("trigger").value = scope.trigger = name;
  $("level").hidden = name !== "level";
  view.mode = name === "cycle" ? "cycle" : "roll";
  scope.zoom = scope.anchor = shown = null;
  ranges.clear();
  ask("view", { view });
}

$("stop").addEventListener("click", stop);
$("inverse-in").addEventListener("click", () => inverse("in"));
$("inverse-out").addEventListener("click", () => inverse("out"));
$("report").addEventListener("click", report);
$("trigger").addEventListener("change", () => setTrigger($("trigger").value));
$("freeze").addEventListener("click", freeze);
$("csv").addEventListener("click", () => shown && saveCsv());
$("png").addEventListener("click", () => shown && savePng());
$("window").replaceChildren(...WINDOWS_S.map((seconds) => new Option(`${seconds} s`, seconds, false, seconds === view.window_s)));
$("window").addEventListener("change", () => {
  view.window_s = Number($("window").value);
  ask("view", { view });
});
$("path-window").replaceChildren(...WINDOWS_S.map((seconds) => new Option(`${seconds} s`, seconds, false, seconds === view.path_s)));
$("path-window").addEventListener("change", () => { view.path_s = Number($("path-window").value); setPath(); });
for (const end of ["across", "up"]) $(`path-${end}`).addEventListener("change", () => { view[end] = $(`path-${end}`).value; setPath(); });
$("reset").addEventListener("click", () => ask("reset"));
for (const id of ["gain", "offset", "over"]) $(id).addEventListener("input", () => { $(id).dataset.touched = "1"; showChange(); });
$("tune").addEventListener("submit", (event) => {
  event.preventDefault();
  const [gain, offset] = ["gain", "offset", "over"].map(typed);
  if ($("tune").reportValidity()) change({ gain, offset }, `gain ${gain}, offset ${offset}`);
});
$("marking").addEventListener("submit", (event) => {
  event.preventDefault();
  request({ command: "mark", text: $("mark").value }, `mark "${$("mark").value}"`);
  $("mark").value = "";
  $("mark").blur();
});
addEventListener("keydown", (event) => {
  const field = event.target.closest?.("input, select, textarea");
  if (event.key === "Escape") {
    event.preventDefault();
    if (field) { delete field.dataset.touched; field.blur(); } else stop(); // it leaves a field first
    return;
  }
  if (field || event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  if (key === "i" && !$("inverse-row").hidden) inverse(status?.inverse === "out" ? "in" : "out");
  else if (key === "m") { event.preventDefault(); $("mark").focus(); }
  else if (key === "r") setTrigger(scope.trigger === "cycle" ? "roll" : "cycle");
  else if (key === "f") freeze();
});

// ---- theme

function theme(name) {
  document.documentElement.dataset.theme = name;
  if (status?.description) build();
}
const dark = matchMedia("(prefers-color-scheme: dark)");
theme(dark.matches ? "dark" : "light");
dark.addEventListener("change", () => theme(dark.matches ? "dark" : "light"));
$("theme").addEventListener("click", () => theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
const resized = new ResizeObserver(() => {
  for (const [id, { plot }] of Object.entries(plots)) plot.setSize(sizes($(id)));
});
// The plot of the lateness shrinks if the text above it takes a second line.
for (const each of [document.querySelector("main"), $("plot-late")]) resized.observe(each);

// ---- at most one frame per refresh, each drawn once

function refresh(now) {
  requestAnimationFrame(refresh);
  if (frame === null || !status?.description || (calm.matches && now - drawn < 250)) return;
  const data = unpack(frame);
  frame = null;
  if (scope.frozen && shown) return;
  const of = `${status.run}/${status.axis}`;
  if (!plots["plot-um"] || plots.of !== of) { build(); Object.defineProperty(plots, "of", { value: of }); }
  draw(data);
  const gap = now - lastFrameMs;
  lastFrameMs = now;
  if (gap < FRESH_MS) usualMs += (gap - usualMs) * 0.05; // of the times: that of the rates would be too high
  drawn = now;
}
let usualMs = 33;
setInterval(() => {
  const old = performance.now() - lastFrameMs > FRESH_MS;
  if (live && performance.now() - saidMs > FRESH_MS) lost("no data");
  $("rate").textContent = old ? "no new frames" : `${number(1000 / usualMs, 0, 2)} frames/s`;
}, 1000);
requestAnimationFrame(refresh);
connect();
