// Draws the charts as their controls say, in the colours of the reader's scheme.

async function opened(element) {
  const bytes = Uint8Array.from(atob(element.textContent), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}

const part = (id) => opened(document.getElementById(id));

const THEMES = JSON.parse(await part("themes"));
const DARK = matchMedia("(prefers-color-scheme: dark)");
const HOVERS = matchMedia("(hover: hover)").matches;
const CONFIG = { responsive: true, displaylogo: false, displayModeBar: HOVERS ? "hover" : false,
  modeBarButtonsToRemove: ["toImage"] };
const NUMBERS = { f4: Float32Array, f8: Float64Array, i1: Int8Array, u1: Uint8Array, i2: Int16Array,
  u2: Uint16Array, i4: Int32Array, u4: Uint32Array };

function unpacked(node) {
  if (Array.isArray(node)) return node.map(unpacked);
  if (node === null || typeof node !== "object") return node;
  if (node.bdata === undefined)
    return Object.fromEntries(Object.entries(node).map(([key, value]) => [key, unpacked(value)]));
  const bytes = Uint8Array.from(atob(node.bdata), (letter) => letter.charCodeAt(0));
  const flat = new NUMBERS[node.dtype](bytes.buffer);
  if (node.shape === undefined) return flat;
  const width = Number(node.shape.split(",")[1]);
  return Array.from({ length: flat.length / width }, (_, row) =>
    flat.subarray(row * width, (row + 1) * width));
}

const theme = () => THEMES[DARK.matches ? "dark" : "light"];

function dressed(trace) {
  const meta = trace.meta ?? {};
  const look = theme();
  if (meta.series !== undefined) {
    const colour = look.lines[meta.series % look.lines.length];
    if (meta.band || trace.stackgroup) trace.fillcolor = colour + (meta.band ? "38" : "b0");
    if (!meta.band) trace.line = { ...trace.line, color: colour };
    if (!meta.band) trace.marker = { ...trace.marker, color: colour };
  }
  if (meta.scaled) trace.marker.colorscale = look.scale;
  if (meta.ground) trace.colorscale = look.ground;
  return trace;
}

// A finger that moves over a flat chart scrolls the page; over a solid one it turns that.
const laid = (layout) => ({ ...layout, template: theme().template, dragmode: HOVERS ? "zoom" : false });

function put(layout, path, value) {
  const names = path.split("."), last = names.pop();
  names.reduce((node, name) => (node[name] ??= {}), layout)[last] = value;
}

class Chart {
  constructor(element, held) {
    Object.assign(this, JSON.parse(held));
    this.figure = unpacked(this.figure);
    this.plot = element.querySelector(".plot");
    this.selects = [...element.querySelectorAll("[data-control]")];
    for (const select of this.selects) select.addEventListener("change", () => this.draw());
    element.querySelector("[data-save]").addEventListener("click", () =>
      Plotly.downloadImage(this.plot, { format: "png", scale: 2, filename: element.id }));
    if (this.cut) this.cut = new Cut(element.querySelector(".cut"), this);
  }

  shown(trace) {
    const when = trace.meta?.when ?? {};
    return this.selects.every(({ dataset: { control }, value }) =>
      when[control] === undefined || when[control] === value);
  }

  async draw() {
    for (const trace of this.figure.data) dressed(trace).visible = this.shown(trace);
    const layout = structuredClone(this.figure.layout);
    for (const { dataset: { control }, value } of this.selects)
      for (const [path, wanted] of Object.entries(this.relayouts[control]?.[value] ?? {}))
        put(layout, path, wanted);
    await Plotly.react(this.plot, this.figure.data, laid(layout), CONFIG);
    if (!this.cut) return;
    this.cut.draw();
    if (!this.listens) this.plot.on("plotly_click", ({ points: [point] }) => this.cut.through(point));
    this.listens = true;
  }
}

class Cut {
  constructor(element, chart) {
    this.chart = chart;
    this.plot = element.querySelector(".plot");
    this.along = element.querySelector("[data-cut=along]");
    this.place = element.querySelector("[data-cut=place]");
    this.at = element.querySelector("[data-cut=at]");
    this.output = element.querySelector("output");
    for (const side of ["x", "y"]) this.along.add(new Option(this.name(side), side));
    this.along.addEventListener("change", () => { this.place.value = ""; this.reset(); });
    this.place.addEventListener("input", () => this.draw());
    this.reset();
  }

  name(side) { return this.chart.figure.layout[side + "axis"].title.text; }

  get across() { return this.along.value === "x" ? "y" : "x"; }

  get maps() { return this.chart.figure.data.filter((trace) => this.chart.shown(trace)); }

  reset() {
    const size = this.maps[0][this.across].length;
    this.place.max = size - 1;
    this.place.value = Math.floor(size / 2);
    this.draw();
  }

  through(point) {
    const [row, column] = point.pointNumber;
    this.place.value = this.across === "y" ? row : column;
    this.draw();
  }

  draw() {
    const place = Math.min(Number(this.place.value), Number(this.place.max));
    const side = this.along.value, [map] = this.maps, layout = this.chart.figure.layout;
    const value = map[this.across][place];
    const told = typeof value === "number" ? Number(value.toPrecision(4)).toString() : value;
    const values = side === "x" ? map.z[place] : map.z.map((row) => row[place]);
    this.at.textContent = `At ${this.name(this.across)}`;
    this.output.textContent = told;
    this.place.setAttribute("aria-valuetext", told);
    this.plot.setAttribute("aria-label",
      `Line of ${layout.title.text} over ${this.name(side)} at ${this.name(this.across)} ${told}`);
    const trace = dressed({ x: map[side], y: values, type: "scatter", mode: "lines", meta: { series: 0 } });
    const room = 0.03 * (map.zmax - map.zmin);
    Plotly.react(this.plot, [trace], laid({
      margin: { l: 10, r: 16, t: 12, b: 50 }, font: layout.font, paper_bgcolor: layout.paper_bgcolor,
      plot_bgcolor: layout.plot_bgcolor, xaxis: layout[side + "axis"],
      yaxis: { range: [map.zmin - room, map.zmax + room], automargin: true, zeroline: false,
        title: { text: layout.title.text.replaceAll(", ", ",<br>"), font: { size: 12 }, standoff: 8 } },
    }), CONFIG);
  }
}

function added(kind, text) {
  const element = document.createElement(kind);
  element.textContent = text;
  document.head.append(element);
}

added("script", await part("plotly"));
const charts = await Promise.all([...document.querySelectorAll("figure.chart")].map(
  async (element) => new Chart(element, await opened(element.querySelector("script")))));
const drawn = Promise.all(charts.map((chart) => chart.draw()));
// DataTables, too, looks at the class.
const mark = () => document.documentElement.classList.toggle("dark", DARK.matches);
DARK.addEventListener("change", () => { mark(); charts.forEach((chart) => chart.draw()); });
mark();
added("style", await part("tables-style"));
const { ITable } = await import(
  URL.createObjectURL(new Blob([await part("tables-library")], { type: "text/javascript" })));
for (const place of document.querySelectorAll(".table"))
  new ITable(place.querySelector("table"), JSON.parse(await opened(place.querySelector("script"))));
// Says that a table is wider than its place, while it is.
const wider = (element) => element.scrollWidth > element.clientWidth + 1;
const widths = new ResizeObserver((changed) => {
  for (const { target } of changed)
    target.previousElementSibling.hidden = ![target, ...target.querySelectorAll("div")].some(wider);
});
for (const table of document.querySelectorAll(".table")) widths.observe(table);
drawn.then(() => { document.documentElement.dataset.drawn = "all"; });
