"use strict";
// Every text of a run is set as textContent, never as markup.
const $ = id => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
let data, shades, model, other, row = 0, column = 0, waits = false;
// Rows of the heat map as they lie in the page, and the kinds of channels that are unfolded.
const lines = [], unfolded = new Set();

// A colour of the light page as this page shows it.
const of = colour => isDark && data.style.dark[colour] || colour;

async function unpacked(id) {
  const packed = Uint8Array.from(atob($(id).textContent), c => c.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}
function add(parent, tag, text, className) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  parent.appendChild(made);
  return made;
}
const shown = value => value === null || value === undefined ? "–" : value >= 100 ? value.toFixed(0) : value >= 10 ? value.toFixed(1) : value.toFixed(2);
const percent = p => p > 0.999 ? "> 99.9 %" : p < 0.001 ? "< 0.1 %" : (100 * p).toFixed(p < 0.01 || p >= 0.99 ? 1 : 0) + " %";

function mix(from, to, share) {
  const part = at => Math.round(parseInt(from.slice(at, at + 2), 16) * (1 - share) + parseInt(to.slice(at, at + 2), 16) * share);
  return [part(1), part(3), part(5)];
}
// One hue from the noise to the worst error of any model, on a logarithmic scale.
function shade(value, most) {
  if (value === null) return null;
  const depth = Math.min(1, Math.max(0, Math.log(Math.max(value, 0.7) / 0.7) / Math.log(Math.max(3, most) / 0.7))) * (shades.length - 1);
  const low = Math.min(Math.floor(depth), shades.length - 2), colour = mix(shades[low], shades[low + 1], depth - low);
  const bright = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2];
  return ["rgb(" + colour.join(",") + ")", bright > 140 ? "#111" : "#fff"];
}

function drawProbabilities() {
  const box = $("probabilities");
  if (!data.hypotheses.length) {
    add(box, "p", "Probabilities are not known yet: lunar-mjx why finds them.", "note");
    $("how").hidden = !data.effects.length;  // nothing to choose from
    return;
  }
  const stack = add(box, "div");
  stack.id = "stack";
  stack.setAttribute("role", "img");
  stack.setAttribute("aria-label", data.hypotheses.map(h => h.name + " " + percent(h.p)).join("; "));
  const fills = ["#0072B2", "#E69F00", "#009E73", "#7A3E68", "#D55E00", "#56B4E9"];
  data.hypotheses.forEach((h, i) => {
    const part = add(stack, "div", h.p > 0.12 ? h.name : "", h.p > 0.12 ? "told" : "");
    part.title = h.name + ": " + percent(h.p);
    part.style.flex = h.p + " 1 0";
    part.style.background = fills[i % fills.length];
    part.style.color = [1, 5].includes(i % fills.length) ? "#111" : "#fff";
  });
  const top = data.hypotheses.slice(0, 3).map(h => h.name + " " + percent(h.p));
  add(box, "p", "Probabilities of what is missing, together 1: " + top.join("; ") + (data.hypotheses.length > 3 ? "; …" : "."), "note");
}

function drawEffects() {
  data.effects.forEach((effect, i) => {
    const item = add($("effects"), "li"), button = add(item, "button");
    button.type = "button";
    button.dataset.effect = i;
    const silent = effect.status === "not tested";
    add(button, "span", effect.name, silent ? "silent" : "");
    const track = add(button, "span", undefined, "track"), bar = add(track, "i");
    bar.style.width = 100 * (effect.p || 0) + "%";
    add(button, "span", effect.p === null ? (effect.status === "named" ? "named" : "–") : silent ? "can't tell" : percent(effect.p), "number");
    button.addEventListener("click", () => chooseEffect(i));
  });
  arrows($("effects"), "button", 1);
}
function drawModels() {
  data.models.forEach((m, i) => {
    const button = add($("models"), "button", m.label + (m.kind === "estimate" ? " (estimate)" : ""));
    button.type = "button";
    button.setAttribute("role", "radio");
    button.addEventListener("click", () => chooseModel(i));
  });
  arrows($("models"), "button", 1);
}
function drawHeat() {
  const table = $("heat"), head = add(add(table, "thead"), "tr");
  add(head, "th");
  for (const unit of data.units) {
    const cell = add(head, "th", unit.name);
    cell.scope = "col";
    if (unit.split !== "fitted") { add(cell, "br"); add(cell, "i", unit.split); }
  }
  const body = add(table, "tbody");
  // One channel of a kind, or with `own` the kind itself, which shows the worst of its channels.
  const draw = (name, rows, kind, own) => {
    const line = add(body, "tr", undefined, own ? "kind" : kind === null ? "" : "member"), title = add(line, "th", own ? undefined : name);
    title.scope = "row";
    lines.push({line: line, name: name, rows: rows, kind: kind, own: own});
    data.units.forEach((unit, c) => {
      const button = add(add(line, "td"), "button");
      button.type = "button";
      button.dataset.column = c;
      if (!own) button.dataset.row = rows[0];
      button.disabled = !rows.some(r => data.panels[r][c]);
      button.addEventListener("click", () => chooseCell(worst(rows, c), c));
    });
    return title;
  };
  data.kinds.forEach((kind, k) => {
    if (kind.rows.length === 1) { draw(data.channels[kind.rows[0]], kind.rows, null, false); return; }
    const button = add(draw(kind.name, kind.rows, k, true), "button", kind.name);
    button.type = "button";
    button.dataset.column = -1;
    button.tabIndex = -1;
    add(button, "span", " (" + kind.rows.length + ")", "note");
    button.addEventListener("click", () => { if (!unfolded.delete(k)) unfolded.add(k); fold(); showHeat(); });
    for (const r of kind.rows) draw(data.channels[r], [r], k, false);
  });
  arrows(table, "tr:not([hidden]) button:not([disabled])", data.units.length);
  $("rows").hidden = !data.many;
  $("filter").addEventListener("input", () => { fold(); showHeat(); table.parentNode.scrollTop = 0; });
  $("unfold").addEventListener("click", () => {
    if (unfolded.size) unfolded.clear();
    else for (const {kind, own} of lines) if (own) unfolded.add(kind);
    fold(); showHeat();
  });
  fold();
}
// The row of the worst error of the chosen model in a column.
function worst(rows, c) {
  const at = r => data.panels[r][c] ? data.models[model].cells[r][c] ?? -1 : -2;
  return rows.reduce((a, b) => at(b) > at(a) ? b : a);
}
// Shows the channels that hold every word of the filter; without one, every kind and the channels of unfolded kinds.
function fold() {
  const words = $("filter").value.toLowerCase().split(/\s+/).filter(word => word);
  let count = 0;
  for (const {line, name, kind, own} of lines) {
    const found = !own && words.every(word => name.toLowerCase().includes(word));
    line.hidden = words.length ? !found : !own && kind !== null && !unfolded.has(kind);
    count += found;
    if (own) line.querySelector("th button").setAttribute("aria-expanded", unfolded.has(kind));
  }
  $("unfold").textContent = unfolded.size ? "Fold all" : "Unfold all";
  $("found").textContent = words.length ? count + " of " + data.channels.length + " channels" : data.channels.length + " channels of " + data.kinds.length + " kinds";
}
// Arrow keys move the focus in a list, or in a table of so many columns; Home and End go to its ends.
function arrows(box, what, columns) {
  box.addEventListener("keydown", event => {
    const list = [...box.querySelectorAll(what)], at = list.indexOf(document.activeElement);
    if (at < 0) return;
    let to;
    if (event.key === "Home") to = list[0];
    else if (event.key === "End") to = list[list.length - 1];
    else if (columns > 1 && event.key === "ArrowUp")
      to = list.slice(0, at).reverse().find(b => b.dataset.column === list[at].dataset.column);
    else if (columns > 1 && event.key === "ArrowDown") to = list.slice(at + 1).find(b => b.dataset.column === list[at].dataset.column);
    else if (event.key === "ArrowLeft" || event.key === "ArrowUp") to = list[at - 1];
    else if (event.key === "ArrowRight" || event.key === "ArrowDown") to = list[at + 1];
    else return;
    event.preventDefault();
    if (to) { to.focus(); if (!to.hasAttribute("aria-expanded")) to.click(); }
  });
}

function showFall() {
  const box = $("fall");
  const chosen = data.models[model], rows = [["as given", data.models[0]]];
  if (data.base !== 0) rows.push(["refitted", data.models[data.base]]);
  if (model !== 0 && model !== data.base) rows.push([chosen.label, chosen]);
  const held = rows.every(r => r[1].held !== null), key = held ? "held" : "fit";
  const most = Math.max(1.2, ...data.models.slice(0, data.base + 1).map(m => m[key] || 0), chosen[key] || 0);
  const before = box.dataset.width || "100%";
  box.textContent = "";
  add(box, "p", "Error on manoeuvres that were " + (held ? "held out, so no fit has seen them" : "fitted") + ". The dashed line, 1 σ (sigma), is the noise of the measurements.", "note");
  const grid = add(box, "div", undefined, "fall");
  for (const [name, m] of rows) {
    add(grid, "span", name);
    const lane = add(grid, "div", undefined, "lane" + (m === chosen ? " now" : "")), bar = add(lane, "i"), noise = add(lane, "b");
    const width = Math.min(100, 100 * (m[key] || 0) / most) + "%";
    noise.style.left = 100 / most + "%";
    if (m === chosen && !still) {
      bar.style.width = before;
      requestAnimationFrame(() => requestAnimationFrame(() => { bar.style.width = width; }));
      box.dataset.width = width;
    } else bar.style.width = width;
    add(grid, "span", shown(m[key]) + " σ", "number");
  }
  if (chosen.kind === "estimate") add(box, "p", "An estimate: the model was not refitted with this effect. What it changes in the fitted manoeuvres, its trace, was scaled until the error was least.", "note");
}
function showWhy() {
  const box = $("why");
  box.textContent = "";
  const effect = other === null ? null : data.effects[other];
  if (!effect) {
    add(box, "p", data.models[model].kind === "given" ? "The model as it was given, before anything was fitted to these measurements." :
      model === data.base ? "The model with its own parameters fitted to these measurements, and no effect added." : "The model with the effects named above, refitted.");
    return;
  }
  add(box, "strong", effect.name);
  if (effect.what) add(box, "p", effect.what, "note");
  add(box, "p", effect.why);
  if (effect.model === null) add(box, "p", "No model with this effect is kept in this run, so the error shown is that of the model chosen before.", "note");
}
function showHeat() {
  const found = data.models[model].cells, most = Math.max(...data.models[0].cells.flat().concat(data.models[data.base].cells.flat()).filter(v => v !== null));
  for (const {line, name, rows} of lines.filter(l => !l.line.hidden)) for (const button of line.querySelectorAll("td button")) {
    const c = Number(button.dataset.column), value = found[worst(rows, c)][c], look = shade(value, most);
    button.textContent = value === null ? "" : shown(value);
    button.style.backgroundColor = look ? look[0] : "transparent";
    button.style.color = look ? look[1] : "inherit";
    button.setAttribute("aria-label", name + ", " + data.units[c].name + ": " + (value === null ? "not known" : shown(value) + " sigma"));
  }
  showChoice();
}
// Marks the chosen field, or that of its folded kind, and lets Tab come to it.
function showChoice() {
  let first;
  for (const {line, rows, kind, own} of lines) for (const button of line.querySelectorAll("td button")) {
    const chosen = !line.hidden && !(own && unfolded.has(kind)) && rows.includes(row) && Number(button.dataset.column) === column;
    button.setAttribute("aria-pressed", chosen);
    button.tabIndex = chosen ? 0 : -1;
    if (!line.hidden && !button.disabled && (chosen || !first)) first = button;
  }
  if (first) first.tabIndex = 0;
  const at = m => shown(data.models[m].cells[row][column]) + " sigma", [drawn, all] = data.panels[row][column].drawn;
  $("chosen").textContent = data.channels[row] + " in " + data.units[column].name + " (" + data.units[column].split + "): " + at(model) +
    (model === data.base ? "" : ", refitted " + at(data.base)) + "." +
    (drawn < all ? " Of " + all + " readings " + drawn + " are drawn: the lowest and the highest residual of each stretch." : "");
}
// Rows of numbers as the page holds them: in steps, less the row above, less the number before.
function numbers([low, step, rows]) {
  let above = null;
  return rows.map(row => {
    let sum = 0;
    above = row.map((v, i) => (sum += v) + (above ? above[i] : 0));
    return above.map(level => level === data.missing ? null : low + step * level);
  });
}
const axes = () => ({gridcolor: of(data.style.rule), linecolor: of(data.style.muted), zeroline: false, ticks: "outside", tickcolor: of(data.style.rule)});
const figure = () => ({paper_bgcolor: of(data.style.paper), plot_bgcolor: of(data.style.paper), font: {family: data.style.font, size: 13, color: of(data.style.ink)}, hovermode: "closest"});
const config = () => ({...data.config, displayModeBar: innerWidth > 820 ? "hover" : false});
function showPanel() {
  const panel = data.panels[row][column], s = data.style;
  const [x] = numbers(panel.x), values = numbers(panel.values), residual = numbers(panel.residual);
  const same = model === data.base, marks = data.table;
  const mode = marks ? "markers" : "lines", size = marks ? 10 : 4;
  const traces = [], measured = {x: x, y: values[0], name: "measured", mode: marks ? "markers" : "lines+markers", marker: {color: of(s.ink), size: size - 2, symbol: "circle"}, line: {color: of(s.ink), width: 1}};
  const draw = (index, colour, symbol, dash, name) => {
    const line = data.models[index].line;
    if (line !== null) traces.push({x: x, y: values[line], name: name, mode: mode, marker: {color: colour, symbol: symbol, size: size}, line: {color: colour, dash: dash, width: 2}});
    traces.push({x: x, y: residual[index], name: name + ", residual", showlegend: line === null, mode: marks ? "markers" : "lines", marker: {color: colour, symbol: symbol, size: size}, line: {color: colour, dash: dash, width: 1.5}, yaxis: "y2"});
  };
  if (!same) draw(data.base, of(s.orange), "triangle-up", "dot", "refitted");
  draw(model, of(s.blue), "square", "solid", same ? "refitted" : model === 0 ? "as given" : "chosen model");
  traces.push(measured);  // on top: models may lie on it
  const axis = axes(), base = figure();
  const layout = Object.assign({}, base, {
    margin: {l: 62, r: 10, t: 44, b: 46}, legend: {orientation: "h", x: 0, y: 1.02, yanchor: "bottom"},
    xaxis: Object.assign({title: {text: panel.x_title}, anchor: "y2"}, axis),
    yaxis: Object.assign({title: {text: panel.y_title}, domain: [0.4, 1], automargin: true}, axis),
    yaxis2: Object.assign({title: {text: "residual, sigma"}, domain: [0, 0.34], automargin: true}, axis),
    shapes: [{type: "rect", xref: "paper", yref: "y2", x0: 0, x1: 1, y0: -2, y1: 2, line: {width: 0}, fillcolor: "rgba(0,114,178,0.12)", layer: "below"}],
  });
  Plotly.react("traces", traces, layout, config());
  $("traces").setAttribute("aria-label", data.channels[row] + " in " + data.units[column].name + ", measured and predicted");
  document.body.dataset.cell = row + "," + column;
}
// The map takes three times as long as the traces, which a reader sees at once while an arrow key is held.
function showMapSoon() {
  if (waits) return;
  waits = true;
  requestAnimationFrame(() => setTimeout(() => { waits = false; showMap(); }));
}
function showMap() {
  const map = data.map, place = $("place"), axis = axes();
  if (!map) {
    if (!place.textContent) add(place, "p", "No position was measured, so there is no map.", "note");
    return;
  }
  const error = map.error[model].map(v => v === null ? null : Math.log10(Math.max(v, 0.3)));
  const top = Math.max(Math.log10(3), ...map.error[data.base].map(v => Math.log10(Math.max(v || 0.3, 0.3))));
  const inside = map.unit.map(u => u === column);
  const points = {x: map.x, y: map.y, mode: "markers", hovertemplate: "%{text} sigma<extra></extra>", text: map.error[model].map(shown), showlegend: false,
    marker: {color: error, colorscale: shades.map((colour, i) => [i / (shades.length - 1), colour]), cmin: Math.log10(0.7), cmax: top,
      size: inside.map(v => v ? 12 : 7), line: {color: of(data.style.ink), width: inside.map(v => v ? 2 : 0.5)},
      colorbar: {title: {text: "sigma"}, tickvals: [0, 0.30103, 0.69897, 1, 1.30103, 2], ticktext: ["1", "2", "5", "10", "20", "100"], thickness: 12}}};
  const square = map.equal ? {scaleanchor: "x", scaleratio: 1} : {};
  Plotly.react("place", [points], Object.assign(figure(), {
    margin: {l: 62, r: 10, t: 44, b: 46}, title: {text: "where: error over all channels", font: {size: 14}, x: 0, xanchor: "left"},
    xaxis: Object.assign({title: {text: map.x_title}}, axis), yaxis: Object.assign({title: {text: map.y_title}}, axis, square)}), config());
  place.setAttribute("aria-label", "Error by place; " + data.units[column].name + " is drawn larger");
}
function show() {
  for (const [i, b] of [...$("models").children].entries()) {
    b.setAttribute("aria-checked", i === model);
    b.tabIndex = i === model ? 0 : -1;
  }
  for (const b of $("effects").querySelectorAll("button")) b.setAttribute("aria-pressed", Number(b.dataset.effect) === other);
  showFall(); showWhy(); showHeat(); showPanel(); showMap();
  document.body.dataset.model = model;
}
function chooseModel(i) { model = i; other = data.effects.findIndex(e => e.model === i); if (other < 0) other = null; show(); }
function chooseEffect(i) { other = i; if (data.effects[i].model !== null) model = data.effects[i].model; show(); }
function chooseCell(r, c) { row = r; column = c; showChoice(); showPanel(); showMapSoon(); }

(async () => {
  try {
    data = JSON.parse(await unpacked("data"));
    shades = data.style.shades.map(of);
    const script = document.createElement("script");
    script.textContent = await unpacked("plotly");
    document.head.appendChild(script);
    drawProbabilities(); drawEffects(); drawModels(); drawHeat();
    for (const line of data.next) add($("next"), "li", line);
    if (data.remains.length) {
      add($("remains"), "p", "How far the model may be trusted: " + data.remains.map(r => r[1]).join("; ") + ".", "note");
    }
    let most = -1;
    data.models[data.base].cells.forEach((line, r) => line.forEach((v, c) => {
      if (v !== null && data.panels[r][c] && v > most) { most = v; row = r; column = c; }
    }));
    const first = data.effects.findIndex(e => e.status === "named" && e.model !== null);
    if (first >= 0) { other = first; model = data.effects[first].model; } else { other = null; model = data.base; }
    if (most >= 0) show();
    document.body.dataset.ready = "true";
  } catch (error) {
    add(document.body, "p", "The studio could not be drawn (" + error + "); use a browser from 2023 or later.");
  }
})();
