// Orbit camera, and the pointer and keyboard that move it.

const V = {
  sub: (a, b) => a.map((v, k) => v - b[k]),
  add: (a, b) => a.map((v, k) => v + b[k]),
  scale: (a, s) => a.map((v) => v * s),
  dot: (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0),
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  unit: (a) => V.scale(a, 1 / (Math.hypot(...a) || 1)),
};

class Camera {
  /** ``half`` is half the size of the scene in metres; all coordinates are relative to its centre. */
  constructor(half, aspect) {
    this.half = half;
    this.extent = Math.max(1, 2 * Math.hypot(...half));
    this.reset(aspect);
  }

  /** Show the whole scene in a picture with a ratio of width to height. */
  reset(aspect) {
    this.target = [0, 0, 0];
    this.azimuth = (-60 * Math.PI) / 180;
    this.elevation = (38 * Math.PI) / 180;
    const corners = () => {
      const { matrix } = this.matrix(aspect);
      return [0, 1, 2, 3, 4, 5, 6, 7].map((k) => {
        const p = this.half.map((v, axis) => ((k >> axis) & 1 ? v : -v));
        return [0, 1, 3].map((r) => matrix[r] * p[0] + matrix[4 + r] * p[1] + matrix[8 + r] * p[2] + matrix[12 + r]);
      });
    };
    const fits = (distance) => {
      this.distance = distance;
      return corners().every(([x, y, w]) => w > 0 && Math.abs(x) < w && Math.abs(y) < w);
    };
    let distance = this.extent * 4;
    while (fits(distance * 0.95)) distance *= 0.95;
    // The corners of the box are rarely occupied.
    this.distance = 0.85 * distance;
    // Near corners are farther from the middle of the picture than far ones.
    const heights = corners().map(([, y, w]) => y / w);
    const middle = (Math.min(...heights) + Math.max(...heights)) / 2;
    this.target = V.scale(this.axes.up, middle * this.distance * Math.tan(this.fieldOfView(aspect) / 2));
  }

  /** Unit vectors: right, up, and from the target to the eye. */
  get axes() {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation),
                              Math.sin(this.elevation)];
    const back = [ce * ca, ce * sa, se];
    const right = [-sa, ca, 0];
    return { right, up: V.cross(back, right), back };
  }

  get eye() {
    return V.add(this.target, V.scale(this.axes.back, this.distance));
  }

  orbit(dx, dy) {
    this.azimuth -= dx;
    this.elevation = Math.min(Math.PI / 2 - 1e-3, Math.max(-Math.PI / 2 + 1e-3, this.elevation + dy));
  }

  /** Move the target in the plane of the picture by shares of the picture's height. */
  pan(dx, dy) {
    const { right, up } = this.axes;
    const size = this.distance * 0.8;
    this.target = V.add(this.target, V.add(V.scale(right, -dx * size), V.scale(up, dy * size)));
  }

  zoom(factor) {
    this.distance = Math.min(20 * this.extent, Math.max(this.extent / 2000, this.distance * factor));
  }

  /** Column-major matrix from the scene to clip space, and the planes of the frustum. */
  matrix(aspect) {
    const near = this.distance / 200;
    const far = this.distance + 4 * this.extent;
    const focal = 1 / Math.tan(this.fieldOfView(aspect) / 2);
    const { right, up, back } = this.axes;
    const eye = this.eye;
    const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    const rows = [
      [...V.scale(right, focal / aspect), (-focal / aspect) * V.dot(right, eye)],
      [...V.scale(up, focal), -focal * V.dot(up, eye)],
      [...V.scale(back, a), -a * V.dot(back, eye) + b],
      [...V.scale(back, -1), V.dot(back, eye)],
    ];
    const matrix = new Float32Array(16);
    for (let r = 0; r < 4; r++) for (let c = 0; c < 4; c++) matrix[4 * c + r] = rows[r][c];
    const planes = [];
    for (let k = 0; k < 3; k++) for (const sign of [1, -1]) planes.push(rows[3].map((v, c) => v + sign * rows[k][c]));
    return { matrix, planes, focal, eye };
  }

  /** Vertical angle; a tall window sees as much from left to right as a square one. */
  fieldOfView(aspect) {
    const half = Math.tan((45 * Math.PI) / 360);
    return 2 * Math.atan(aspect < 1 ? half / aspect : half);
  }
}

/** Let pointer, wheel and keys of a canvas move a camera; ``aspect`` is that of a view, ``onClick`` gets a click. */
function connectCamera(canvas, camera, aspect, onMove, onClick) {
  const pointers = new Map();
  let travel = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    travel = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = V.scale(V.sub(now, before), 1 / canvas.clientHeight);
    travel += Math.hypot(dx, dy);
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      camera.zoom(Math.hypot(...V.sub(before, other)) / Math.max(1, Math.hypot(...V.sub(now, other))));
      camera.pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) camera.pan(dx, dy);
    else camera.orbit(4 * dx, 4 * dy);
    pointers.set(event.pointerId, now);
    onMove();
  });
  const release = (event) => {
    const isClick = pointers.size === 1 && pointers.has(event.pointerId) && travel < 0.01 && event.type === "pointerup";
    pointers.delete(event.pointerId);
    if (isClick && event.button === 0) onClick(event.offsetX, event.offsetY);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(Math.sign(event.deltaY) * Math.min(0.3, Math.abs(event.deltaY) / 500)));
    onMove();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 0.03 : 0.08;
    const actions = {
      ArrowLeft: () => (event.altKey ? camera.pan(-step, 0) : camera.orbit(-step, 0)),
      ArrowRight: () => (event.altKey ? camera.pan(step, 0) : camera.orbit(step, 0)),
      ArrowUp: () => (event.altKey ? camera.pan(0, -step) : camera.orbit(0, step)),
      ArrowDown: () => (event.altKey ? camera.pan(0, step) : camera.orbit(0, -step)),
      "+": () => camera.zoom(0.9), "=": () => camera.zoom(0.9), "-": () => camera.zoom(1.1), 0: () => camera.reset(aspect()),
      Enter: () => onClick(canvas.clientWidth / 2, canvas.clientHeight / 2),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    onMove();
  });
}
