// The page: state, controls, and the picture of it.

const byId = (id) => document.getElementById(id);
const COLORS = { label: "class", height: "height", seen: "robots that saw it", first: "robot that saw it first",
                 probability: "probability", disagreement: "disagreement", contradiction: "contradiction" };
const OF_TEAM = ["seen", "first", "disagreement", "contradiction"];

function showProblem(text) {
  byId("problem").hidden = false;
  byId("problem").textContent = text;
}

function layerTitle(layer) {
  if (layer.kind === "team") return "team";
  if (layer.kind === "central") return "all evidence";
  return layer.kind === "evidence" ? `${layer.robot}, own scans` : `${layer.robot}, map`;
}

/** What is drawn of the data, in the form that the renderer wants. */
function sceneOf(data) {
  const colors = Array.from({ length: 256 }, () => [150, 150, 150]);
  const classNames = { 0: "free" };
  for (const { id, name, color } of data.classes) {
    colors[id] = color;
    classNames[id] = name;
  }
  const robotColors = [[150, 150, 150], ...data.robots.map((robot) => robot.color)];
  while (robotColors.length < 256) robotColors.push([235, 235, 235]);
  const mean = (robots) => [0, 1, 2].map((k) => robots.reduce((sum, r) => sum + data.robots[r].color[k], 0) / robots.length);
  const [low, high] = data.box;
  return {
    resolution: data.resolution, robots: data.robots, classNames, classColors: colors, robotColors, masks: data.masks,
    contradictions: data.contradictions,
    maskColors: data.masks.map((robots) => (robots.length ? mean(robots).map(Math.round) : [150, 150, 150])),
    center: low.map((v, k) => (v + high[k]) / 2), half: high.map((v, k) => (v - low[k]) / 2),
  };
}

class Page {
  constructor(data) {
    this.data = data;
    this.scene = sceneOf(data);
    this.layers = new Map(data.layers.map((description) => [description.name, new Layer(description, data.pools)]));
    this.state = {
      row: data.times.length - 1, layer: data.layers.length ? data.layers[0].name : "", beside: "",
      // Maps without labels have one class.
      color: data.classes.length > 1 ? "label" : "height",
      hiddenClasses: new Set(), hiddenRobots: new Set(), free: false, paths: true,
      heights: [...data.heights],
    };
    this.readAddress();
    this.camera = new Camera(this.scene.half, this.aspect());
    this.charts = this.makeCharts();
    this.makeControls();
    try {
      this.renderer = new Renderer(byId("canvas"), this.scene);
    } catch (error) {
      this.showPictures();
    }
    if (this.renderer) {
      connectCamera(byId("canvas"), this.camera, () => this.aspect(), () => this.redraw(), (x, y) => this.pick(x, y));
      new ResizeObserver(() => this.redraw()).observe(byId("stage"));
      byId("canvas").addEventListener("webglcontextlost", (event) => {
        event.preventDefault();
        this.renderer = null;
        this.showPictures();
      });
    }
    if (!this.layers.size) showProblem("The result holds no map; charts and tables are below.");
    this.update();
  }

  /** Read settings such as #time=30&color=height&layer=central&beside=husky_1 from the address. */
  readAddress() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    const { state, data } = this;
    const time = Number(wanted.get("time") ?? NaN);
    if (Number.isFinite(time)) state.row = this.rowAt(time);
    for (const name of ["layer", "beside"]) if (this.layers.has(wanted.get(name))) state[name] = wanted.get(name);
    if (this.colors().includes(wanted.get("color"))) state.color = wanted.get("color");
    state.free = wanted.get("free") === "1" && data.layers.length > 0;
  }

  /** Ratio of width to height of one map in the picture. */
  aspect() {
    const { clientWidth, clientHeight } = byId("stage");
    return clientWidth / clientHeight / (this.state.beside ? 2 : 1);
  }

  /** Tick at or before a time [s]. */
  rowAt(time) {
    const { times } = this.data;
    let row = 0;
    while (row + 1 < times.length && times[row + 1] <= time + 1e-9) row++;
    return row;
  }

  /** Index of the stored maps at a tick, -1 before the first ones. */
  storedAt(row) {
    return this.data.storedRows.reduce((found, stored, index) => (stored <= row ? index : found), -1);
  }

  /** Colours that the data have. */
  colors() {
    const { data } = this;
    return Object.keys(COLORS).filter((name) =>
      (name !== "first" || data.hasFirst) && (!["seen", "contradiction"].includes(name) || data.hasEvidence));
  }

  makeCharts() {
    const colors = this.data.robots.map(({ color }) => `rgb(${color.join(" ")})`);
    const charts = this.data.charts.map((description) =>
      new Chart(description, this.data.times, this.data.settlingFrom, colors, (time) => this.seek(time)));
    byId("charts").append(...charts.map((chart) => chart.element));
    if (this.data.settlingFrom !== null) {
      byId("charts").append(textElement("p", "Grey band: the logs have ended, and the robots only exchange maps."));
    }
    return charts;
  }

  makeControls() {
    const { state, data, scene } = this;
    const options = [...this.layers.values()].map((layer) => new Option(layerTitle(layer), layer.name));
    byId("layer").append(...options);
    byId("beside").append(new Option("nothing", ""), ...options.map((option) => option.cloneNode(true)));
    byId("color").append(...this.colors().map((name) => new Option(COLORS[name], name)));
    for (const name of ["layer", "beside", "color"]) {
      byId(name).value = state[name];
      byId(name).addEventListener("change", (event) => this.set({ [name]: event.target.value }));
    }
    for (const name of ["free", "paths"]) {
      byId(name).checked = state[name];
      byId(name).addEventListener("change", (event) => this.set({ [name]: event.target.checked }));
    }
    byId("classes").append(...data.classes.map(({ id, name, color }) => toggle(name, color, (isOn) => this.hide("hiddenClasses", id, !isOn))));
    byId("robots").append(...data.robots.map(({ id, color }, k) => toggle(id, color, (isOn) => this.hide("hiddenRobots", k, !isOn))));
    ["low", "high"].forEach((name, k) => {
      const [least, most] = data.heights;
      const numSteps = Math.max(1, Math.round((most - least) / scene.resolution));
      Object.assign(byId(name), { min: 0, max: numSteps, step: 1, value: k ? numSteps : 0 });
      byId(name).addEventListener("input", (event) => {
        const heights = [...this.state.heights];
        heights[k] = least + (Number(event.target.value) / numSteps) * (most - least);
        this.set({ heights });
      });
    });
    Object.assign(byId("time"), { max: data.times.length - 1, value: state.row });
    byId("time").addEventListener("input", (event) => {
      this.stop();
      this.set({ row: Number(event.target.value) });
    });
    byId("play").addEventListener("click", () => this.play());
    byId("theme").addEventListener("click", () => {
      const isDark = document.documentElement.dataset.theme === "dark";
      document.documentElement.dataset.theme = isDark ? "light" : "dark";
    });
  }

  set(changes) {
    Object.assign(this.state, changes);
    this.update();
  }

  hide(name, value, isHidden) {
    const values = new Set(this.state[name]);
    if (isHidden) values.add(value);
    else values.delete(value);
    this.set({ [name]: values });
  }

  seek(time) {
    this.stop();
    this.set({ row: this.rowAt(time) });
  }

  /** Play the log ten times as fast as it was recorded, or stop. */
  play() {
    const { data, state } = this;
    if (this.playing) return this.stop();
    byId("play").textContent = "❚❚";
    byId("play").setAttribute("aria-label", "Pause");
    const start = state.row === data.times.length - 1 ? data.times[0] : data.times[state.row];
    const begun = performance.now();
    const step = () => {
      const time = start + (performance.now() - begun) / 100;
      const row = this.rowAt(time);
      if (row !== state.row) this.set({ row });
      if (row === data.times.length - 1) this.stop();
      else this.playing = requestAnimationFrame(step);
    };
    this.playing = requestAnimationFrame(step);
  }

  stop() {
    cancelAnimationFrame(this.playing);
    this.playing = null;
    byId("play").textContent = "▶";
    byId("play").setAttribute("aria-label", "Play");
  }

  /** Make everything show the state. */
  update() {
    const { state, data } = this;
    byId("time").value = state.row;
    const stored = this.storedAt(state.row);
    const age = stored < 0 ? "no map yet" : `map of ${data.times[data.storedRows[stored]].toFixed(1)} s`;
    byId("now").textContent = `${data.times[state.row].toFixed(1)} s · ${age}`;
    byId("time").setAttribute("aria-valuetext", `${data.times[state.row].toFixed(1)} seconds, ${age}`);
    ["low", "high"].forEach((name, k) => {
      byId(`${name}-value`).textContent = `${state.heights[k].toFixed(1)} m`;
      byId(name).setAttribute("aria-valuetext", `${state.heights[k].toFixed(1)} metres`);
    });
    this.charts.forEach((chart) => chart.showRow(state.row));
    this.showScale();
    this.redraw();
  }

  /** Legend of the colours. */
  showScale() {
    const { state, scene, data } = this;
    const parts = [];
    const isTeam = this.layers.get(state.layer)?.kind === "team";
    if (OF_TEAM.includes(state.color) && !isTeam) parts.push(textElement("p", "Only the team's map has these values."));
    const ends = { height: state.heights.map((v) => `${v.toFixed(1)} m`), probability: [data.leastProbability.toFixed(2), "1"],
                   disagreement: ["0, opaque", `${shortNumber(data.largestDisagreement)}, transparent`] }[state.color];
    if (ends) {
      const ramp = document.createElement("div");
      ramp.className = "ramp";
      const stops = RAMP.map((color) => `rgb(${color.join(" ")})`).join(", ");
      ramp.style.background = `linear-gradient(to right, ${state.color === "disagreement" ? "#666, transparent" : stops})`;
      const line = document.createElement("div");
      line.className = "ends";
      line.append(...ends.map((text) => textElement("span", text)));
      parts.push(ramp, line);
    }
    const keys = { contradiction: data.contradictions.map(({ name, color }) => [`rgb(${color.join(" ")})`, name]),
                   first: [...data.robots.map(({ id, color }) => [`rgb(${color.join(" ")})`, id]), ["rgb(235 235 235)", "several at once"]],
                   seen: data.robots.map(({ id, color }) => [`rgb(${color.join(" ")})`, id]) }[state.color];
    if (keys) {
      const line = document.createElement("p");
      line.className = "legend";
      line.append(...keys.map(([color, text]) => {
        const key = document.createElement("i");
        key.style.background = color;
        const entry = textElement("span", text);
        entry.prepend(key);
        return entry;
      }));
      parts.push(line);
    }
    const note = { probability: "Probability of the cell's class.",
                   seen: "A mixed colour: several robots.",
                   disagreement: "Largest distance between the log-odds of two robots." }[state.color];
    if (note) parts.push(textElement("p", note));
    if (["seen", "contradiction"].includes(state.color) && data.evidenceNote) parts.push(textElement("p", data.evidenceNote));
    byId("scale").replaceChildren(...parts);
  }

  redraw() {
    if (this.frame || !this.renderer) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = null;
      this.draw();
    });
  }

  /** Frame of a map at the time: that of its robot, or of the largest group of robots. */
  frameOf(layer) {
    const { data, state } = this;
    const robot = data.robots.findIndex(({ id }) => id === layer.robot);
    return robot < 0 ? data.frames.team[state.row] : data.frames.robots[robot * data.times.length + state.row];
  }

  /** Whether a robot is shown in a frame at a tick. */
  isShown(robot, frame, row) {
    const { data, state } = this;
    return !state.hiddenRobots.has(robot) && data.frames.robots[robot * data.times.length + row] === frame;
  }

  /** Views to draw: the chosen map, and the one beside it. */
  views() {
    const { state, scene, data } = this;
    const tick = this.storedAt(state.row);
    const names = [state.layer, state.beside].filter((name) => this.layers.has(name));
    return names.map((name) => {
      const layer = this.layers.get(name);
      const frame = this.frameOf(layer);
      const lines = state.paths ? this.pathLines(frame) : [];
      const mode = layer.kind !== "team" && OF_TEAM.includes(state.color) ? "label" : state.color;
      return {
        layer, frame, tick, mode, lines, filter: new Filter({ ...state, color: mode }, data.masks), range: state.heights,
        scale: mode === "disagreement" ? data.largestDisagreement || 1 : data.leastProbability,
      };
    });
  }

  draw() {
    const { renderer } = this;
    if (!renderer) return;
    const canvas = byId("canvas");
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const views = this.views();
    const isPartial = renderer.draw(views, this.camera);
    this.placeNames(views);
    byId("titles").replaceChildren(...views.map(({ layer }) => textElement("span", layerTitle(layer) + (layer.title && `: ${layer.title}`))));
    if (isPartial) this.redraw();
    byId("canvas").dataset.state = isPartial || renderer.isWaiting ? "loading" : "ready";
  }

  /** Lines in a frame: of the paths up to the time, of the robots' axes of view, and of the links. */
  pathLines(frame) {
    const { data, state, scene } = this;
    const lines = [];
    const at = (robot, row) => {
      const { poses } = data.poses[robot];
      return V.sub([...poses.subarray(7 * row, 7 * row + 3)], scene.center);
    };
    const isShown = (robot) => this.isShown(robot, frame, state.row);
    const colors = data.robots.map(({ color }) => color.map((v) => v / 255));
    const add = (a, b, color, alpha = 1) => {
      if ([...a, ...b].every(Number.isFinite)) lines.push(...a, ...b, ...color, alpha);
    };
    data.robots.forEach((_, robot) => {
      if (!isShown(robot)) return;
      for (let row = 1; row <= state.row; row++) {
        const isPlaced = this.isShown(robot, frame, row - 1) && this.isShown(robot, frame, row);
        if (isPlaced) add(at(robot, row - 1), at(robot, row), colors[robot]);
      }
      this.addRobot(add, at(robot, state.row), data.poses[robot].poses.subarray(7 * state.row + 3, 7 * state.row + 7), colors[robot]);
    });
    const { pairs, sent, delivered } = data.links;
    for (let link = 0; link < pairs.length / 2; link++) {
      const [a, b] = [pairs[2 * link], pairs[2 * link + 1]];
      const place = link * data.times.length + state.row;
      if (!sent[place] || !isShown(a) || !isShown(b)) continue;
      const color = delivered[place] ? [0.1, 0.55, 0.25] : [0.84, 0.1, 0.1];
      const raised = (p) => V.add(p, [0, 0, 0.004 * this.camera.extent]);
      add(raised(at(a, state.row)), raised(at(b, state.row)), color);
    }
    return lines;
  }

  /** Frustum of a robot's sensor: z ahead, x right, y down. */
  addRobot(add, position, turn, color) {
    const size = 0.02 * this.camera.extent;
    const corner = (x, y, z) => V.add(position, rotated(turn, [x * size, y * size, z * size]));
    const corners = [[-0.7, -0.5, 1], [0.7, -0.5, 1], [0.7, 0.5, 1], [-0.7, 0.5, 1]].map((p) => corner(...p));
    corners.forEach((p, k) => {
      add(position, p, color);
      add(p, corners[(k + 1) % 4], color);
    });
  }

  /** Put the robots' names where the robots are. */
  placeNames(views) {
    const numViews = views.length;
    const { data, state, scene, camera } = this;
    const box = byId("names");
    const { matrix } = camera.matrix(box.clientWidth / numViews / box.clientHeight);
    const names = [];
    for (let k = 0; k < numViews; k++) {
      data.robots.forEach(({ id, color }, robot) => {
        const { poses } = data.poses[robot];
        const p = V.sub([...poses.subarray(7 * state.row, 7 * state.row + 3)], scene.center);
        if (!state.paths || !this.isShown(robot, views[k].frame, state.row) || !p.every(Number.isFinite)) return;
        const clip = [0, 1, 3].map((r) => matrix[r] * p[0] + matrix[4 + r] * p[1] + matrix[8 + r] * p[2] + matrix[12 + r]);
        const [x, y] = [clip[0] / clip[2], clip[1] / clip[2]];
        if (clip[2] <= 0 || Math.abs(x) > 1 || Math.abs(y) > 1) return;
        const name = textElement("span", id);
        // Shares of the box hold in a print too, which scales the picture.
        name.style.left = `${(100 * (k + (x + 1) / 2)) / numViews}%`;
        name.style.top = `${50 * (1 - y)}%`;
        name.style.borderColor = `rgb(${color.join(" ")})`;
        names.push(name);
      });
    }
    box.replaceChildren(...names);
  }

  /** Show the cell under a place of the canvas [CSS pixel]; returns the answer. */
  pick(x, y) {
    if (!this.views().length) return null;
    const canvas = byId("canvas");
    const ratio = canvas.width / canvas.clientWidth;
    const hit = this.renderer.pick(this.views(), this.camera, Math.floor(x * ratio), canvas.height - 1 - Math.floor(y * ratio));
    this.answer = hit && answerOf(this, hit);
    showAnswer(this, this.answer);
    return this.answer;
  }

  showPictures() {
    byId("canvas").hidden = true;
    byId("pictures").hidden = false;
    showProblem("This browser has no WebGL 2, so that the map cannot be turned. These pictures show its last state.");
  }
}

/** Checkbox with a name and a colour. */
function toggle(name, color, onChange) {
  const label = document.createElement("label");
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
  box.addEventListener("change", () => onChange(box.checked));
  const key = document.createElement("i");
  key.style.background = `rgb(${color.join(" ")})`;
  label.append(box, key, name);
  return label;
}

/** Vector turned by a unit quaternion x, y, z, w. */
function rotated([x, y, z, w], v) {
  const u = [x, y, z];
  const t = V.scale(V.cross(u, v), 2);
  return V.add(V.add(v, V.scale(t, w)), V.cross(u, t));
}

if (matchMedia("(prefers-color-scheme: dark)").matches) document.documentElement.dataset.theme = "dark";
try {
  const data = await loadData(() => window.page?.redraw());
  window.page = new Page(data);
  window.addEventListener("beforeprint", () => window.page.draw());
} catch (error) {
  showProblem(`The page's data cannot be read: ${error.message}`);
  byId("pictures").hidden = false;
  byId("canvas").hidden = true;
  throw error;
}
