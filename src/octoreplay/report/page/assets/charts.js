// Line charts on one time axis with one cursor.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 52, right: 8, top: 6, bottom: 20 };
const CHART_HEIGHT = 150;
/** Dashes of the lines of the team, in the chart and in the legend. */
const DASHES = [["none", "solid"], ["7 3", "dashed"], ["2 2", "dotted"]];
/** Largest number of lines that have an entry in the legend. */
const LEGEND_LINES = 10;

function svgElement(name, attributes, parent) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.append(element);
  return element;
}

/** A number with about four significant digits. */
function shortNumber(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6 || (size > 0 && size < 1e-3)) return value.toExponential(2);
  if (size >= 1000) return Math.round(value).toLocaleString("en-US");
  return Number(value.toPrecision(4)).toString();
}

/** Round values between two bounds, about five. */
function niceTicks(low, high, isLog) {
  if (isLog) {
    const found = [];
    const step = Math.max(1, Math.ceil((Math.log10(high) - Math.log10(low)) / 5));
    for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.log10(high) + 1e-9; e += step) found.push(10 ** e);
    return found;
  }
  const raw = (high - low) / 4;
  const base = 10 ** Math.floor(Math.log10(raw));
  const step = base * ([1, 2, 5].find((k) => k * base >= raw) ?? 10);
  const found = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) found.push(Number(v.toPrecision(12)));
  return found;
}

class Chart {
  /** ``onSeek`` gets the time of a click [s]. */
  constructor(description, times, settlingFrom, colors, onSeek) {
    Object.assign(this, { description, times, settlingFrom, colors, onSeek, row: 0 });
    this.element = document.createElement("figure");
    this.element.className = "chart";
    this.element.id = `chart-${description.id}`;
    const caption = document.createElement("figcaption");
    const unit = description.unit ? ` [${description.unit}]` : "";
    caption.textContent = `${description.title}${unit}`;
    this.svg = svgElement("svg", { role: "img", height: CHART_HEIGHT, "aria-label": this.summary() });
    this.legend = document.createElement("div");
    this.legend.className = "legend";
    this.element.append(caption, this.svg, this.legend);
    const seek = (event) => {
      if (event.type === "pointermove" && !event.buttons) return;
      const { left } = this.svg.getBoundingClientRect();
      const share = (event.clientX - left - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
      this.onSeek(times[0] + Math.min(1, Math.max(0, share)) * (times[times.length - 1] - times[0]));
    };
    this.svg.addEventListener("pointerdown", seek);
    this.svg.addEventListener("pointermove", seek);
    new ResizeObserver(() => this.draw()).observe(this.element);
  }

  /** Last values as a sentence, for screen readers. */
  summary() {
    const { title, unit, lines } = this.description;
    const last = lines.slice(0, LEGEND_LINES).map(({ name, values }) => `${name} ${shortNumber(values[values.length - 1])}`);
    return `${title}, last values${unit ? ` in ${unit}` : ""}: ${last.join(", ")}`;
  }

  draw() {
    const { description, times, svg } = this;
    this.width = Math.max(200, svg.getBoundingClientRect().width);
    // A print has other widths, to which the drawing is scaled.
    svg.setAttribute("viewBox", `0 0 ${this.width} ${CHART_HEIGHT}`);
    svg.replaceChildren();
    const isLog = description.scale === "log";
    const shown = description.lines.flatMap(({ values }) => [...values]).filter((v) => Number.isFinite(v) && (!isLog || v > 0));
    let [low, high] = shown.length ? [shown.reduce((a, b) => Math.min(a, b)), shown.reduce((a, b) => Math.max(a, b))] : isLog ? [1, 10] : [0, 1];
    if (isLog) [low, high] = [low / 1.5, high * 1.5];
    else {
      const room = 0.06 * (high - low) || Math.abs(high) * 0.05 || 1;
      [low, high] = [low >= 0 && low < room * 4 ? 0 : low - room, high + room];
    }
    const span = times[times.length - 1] - times[0] || 1;
    this.x = (t) => MARGIN.left + ((t - times[0]) / span) * (this.width - MARGIN.left - MARGIN.right);
    const of = isLog ? Math.log : (v) => v;
    this.y = (v) => CHART_HEIGHT - MARGIN.bottom - ((of(v) - of(low)) / (of(high) - of(low))) * (CHART_HEIGHT - MARGIN.top - MARGIN.bottom);
    if (this.settlingFrom !== null) {
      const start = this.x(this.settlingFrom);
      svgElement("rect", { class: "settling", x: start, y: MARGIN.top, width: Math.max(0, this.width - MARGIN.right - start),
                           height: CHART_HEIGHT - MARGIN.top - MARGIN.bottom }, svg);
    }
    for (const value of niceTicks(low, high, isLog)) {
      svgElement("line", { class: "grid", x1: MARGIN.left, x2: this.width - MARGIN.right, y1: this.y(value), y2: this.y(value) }, svg);
      const label = svgElement("text", { class: "axis", x: MARGIN.left - 5, y: this.y(value) + 3.5, "text-anchor": "end" }, svg);
      label.textContent = isLog ? shortNumber(value) : compact(value, high - low);
    }
    for (const value of niceTicks(times[0], times[times.length - 1], false)) {
      const label = svgElement("text", { class: "axis", x: this.x(value), y: CHART_HEIGHT - 5, "text-anchor": "middle" }, svg);
      label.textContent = `${value} s`;
    }
    description.lines.forEach((line, k) => {
      svgElement("path", { class: "line", d: this.path(line.values, isLog), stroke: this.color(line, k),
                           "stroke-dasharray": line.robot < 0 ? DASHES[Math.min(k, 2)][0] : "none" }, svg);
    });
    this.cursor = svgElement("line", { class: "cursor", y1: MARGIN.top, y2: CHART_HEIGHT - MARGIN.bottom }, svg);
    this.showRow(this.row);
  }

  color(line, k) {
    return line.robot >= 0 ? this.colors[line.robot] : `var(--line-${Math.min(k, 2)})`;
  }

  /** Path through the values; a line has gaps where a value is missing or has no place on a logarithmic axis. */
  path(values, isLog) {
    let text = "";
    let isDown = false;
    for (let i = 0; i < values.length; i++) {
      const isShown = Number.isFinite(values[i]) && (!isLog || values[i] > 0);
      if (isShown) text += `${isDown ? "L" : "M"}${this.x(this.times[i]).toFixed(1)} ${this.y(values[i]).toFixed(1)}`;
      isDown = isShown;
    }
    return text;
  }

  /** Move the cursor to a tick and show its values. */
  showRow(row) {
    this.row = row;
    if (!this.cursor) return;
    const x = this.x(this.times[row]);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    const { lines, unit } = this.description;
    const ranked = lines.map((line, k) => [line, k]);
    if (lines.length > LEGEND_LINES) ranked.sort(([a], [b]) => (b.values[row] || 0) - (a.values[row] || 0));
    const entries = ranked.slice(0, LEGEND_LINES).map(([line, k]) => {
      const entry = document.createElement("span");
      const key = document.createElement("i");
      if (line.robot < 0) {
        key.className = "line-key";
        key.style.borderTop = `3px ${DASHES[Math.min(k, 2)][1]} ${this.color(line, k)}`;
      } else key.style.background = this.color(line, k);
      entry.append(key, `${line.name} ${unit.startsWith("B") ? sizeText(line.values[row]) : shortNumber(line.values[row])}`);
      return entry;
    });
    if (lines.length > LEGEND_LINES) entries.push(`and ${lines.length - LEGEND_LINES} more`);
    this.legend.replaceChildren(...entries);
  }
}

/** Label of a value on an axis: as many digits as its steps need. */
function compact(value, span) {
  const size = Math.abs(value);
  if (size >= 1e9) return `${shortNumber(value / 1e9)}G`;
  if (size >= 1e6) return `${shortNumber(value / 1e6)}M`;
  if (size >= 1e4) return `${shortNumber(value / 1e3)}k`;
  const digits = Math.max(0, Math.min(8, Math.ceil(-Math.log10(span / 10))));
  return value.toFixed(digits);
}

function sizeText(bytes) {
  if (!Number.isFinite(bytes)) return "–";
  for (const [unit, size] of [["GB", 1e9], ["MB", 1e6], ["kB", 1e3]]) {
    if (bytes >= size) return `${Number((bytes / size).toPrecision(3))} ${unit}`;
  }
  return `${bytes} B`;
}
