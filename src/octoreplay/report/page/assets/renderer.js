// Drawing of tiles, paths and links with WebGL 2.

const CUBE_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D faces;
uniform mat4 matrix;
uniform vec3 origin;
uniform float cell;
uniform int mode;
uniform vec2 heights;
uniform float scale;
uniform highp sampler2D classColors;
uniform highp sampler2D maskColors;
uniform highp sampler2D robotColors;
uniform highp sampler2D contradictionColors;
uniform highp sampler2D ramp;
flat out vec4 color;
flat out uint owner;
out vec2 place;
flat out float edge;

vec3 onRamp(float value) {
  return texture(ramp, vec2(clamp(value, 0.0, 1.0) * 0.9 + 0.05, 0.5)).rgb;
}

void main() {
  // Six vertices for each face; a draw call per face, as with instances, would be slow.
  int number = gl_VertexID / 6;
  int corner = gl_VertexID - 6 * number;
  corner = corner < 3 ? corner : corner == 3 ? 2 : corner == 4 ? 1 : 3;
  uvec4 face = texelFetch(faces, ivec2(number & 1023, number >> 10), 0);
  uint a = face.x;
  vec3 low = vec3(float(a & 31u), float((a >> 5) & 31u), float((a >> 10) & 31u));
  edge = float(1u << ((a >> 15) & 7u));
  int direction = int((a >> 18) & 7u);
  int axis = direction >> 1;
  vec2 uv = vec2(float(corner & 1), float(corner >> 1));
  bool isPositive = (direction & 1) == 0;
  // The order of the corners makes the front of the face counter-clockwise.
  vec2 ab = isPositive ? uv : uv.yx;
  vec3 offset = axis == 0 ? vec3(isPositive ? 1.0 : 0.0, ab) : axis == 1 ? vec3(ab.y, isPositive ? 1.0 : 0.0, ab.x)
                                                             : vec3(ab, isPositive ? 1.0 : 0.0);
  vec3 position = origin + (low + offset * edge) * cell;
  gl_Position = matrix * vec4(position, 1.0);
  place = uv;
  owner = uint(number);

  int label = int((a >> 21) & 255u);
  bool isFree = ((a >> 29) & 1u) == 1u;
  float probability = float(face.y & 65535u) / 65535.0;
  float disagreement = float(face.y >> 16) / 500.0;
  vec4 chosen = vec4(texelFetch(classColors, ivec2(label, 0), 0).rgb, 1.0);
  int mask = int(face.z & 65535u);
  int first = int((face.z >> 16) & 255u);
  int contradiction = int(face.z >> 24);
  if (mode == 1) chosen.rgb = onRamp((origin.z + (low.z + 0.5 * edge) * cell - heights.x) / max(heights.y - heights.x, 1e-6));
  if (mode == 2) chosen.rgb = mask == 0 ? vec3(0.6) : texelFetch(maskColors, ivec2(mask & 1023, mask >> 10), 0).rgb;
  if (mode == 3) chosen.rgb = first == 0 ? vec3(0.6) : texelFetch(robotColors, ivec2(first, 0), 0).rgb;
  if (mode == 4) chosen.rgb = onRamp((probability - scale) / (1.0 - scale));
  if (mode == 5) chosen.a = clamp(1.0 - disagreement / scale, 0.1, 1.0);
  if (mode == 6) chosen.rgb = texelFetch(contradictionColors, ivec2(contradiction, 0), 0).rgb;
  if (isFree) chosen = vec4(0.55, 0.75, 0.95, 0.12);
  float light = axis == 2 ? (isPositive ? 1.0 : 0.5) : axis == 0 ? (isPositive ? 0.86 : 0.68) : (isPositive ? 0.76 : 0.62);
  color = vec4(chosen.rgb * light, chosen.a);
}`;

const CUBE_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
flat in vec4 color;
flat in uint owner;
in vec2 place;
flat in float edge;
uniform uint tileNumber;
uniform bool isPicking;
layout(location = 0) out vec4 shown;
layout(location = 1) out uvec2 picked;

// Ordered dithering (Bayer, 1973): transparency without sorting.
float threshold(ivec2 pixel) {
  int x = pixel.x & 3, y = pixel.y & 3;
  int rank = ((x ^ y) & 1) * 8 + (y & 1) * 4 + (((x ^ y) >> 1) & 1) * 2 + (y >> 1 & 1);
  return (float(rank) + 0.5) / 16.0;
}

void main() {
  if (color.a < 1.0 && color.a < threshold(ivec2(gl_FragCoord.xy))) discard;
  // Lines along the edges of cubes, as long as a cube is several pixels wide.
  vec2 width = fwidth(place);
  vec2 near = min(place, 1.0 - place) / max(width, 1e-6);
  float line = 1.0 - clamp(min(near.x, near.y) / 1.2, 0.0, 1.0);
  float visible = clamp((0.25 - max(width.x, width.y)) * 8.0, 0.0, 1.0);
  shown = vec4(color.rgb * (1.0 - 0.22 * line * visible), 1.0);
  picked = isPicking ? uvec2(tileNumber + 1u, owner) : uvec2(0u);
}`;

const LINE_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 start;
layout(location = 1) in vec3 end;
layout(location = 2) in vec4 tint;
uniform mat4 matrix;
uniform vec2 size;
uniform float width;
out vec4 color;
void main() {
  vec4 a = matrix * vec4(start, 1.0), b = matrix * vec4(end, 1.0);
  vec2 along = (b.xy / max(b.w, 1e-6) - a.xy / max(a.w, 1e-6)) * size;
  vec2 across = length(along) > 1e-6 ? normalize(vec2(-along.y, along.x)) : vec2(0.0, 1.0);
  bool isEnd = (gl_VertexID & 1) == 1;
  vec4 at = isEnd ? b : a;
  at.xy += across * (gl_VertexID < 2 ? 1.0 : -1.0) * width / size * at.w;
  at.z -= 0.0005 * at.w;
  gl_Position = at;
  color = tint;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 color;
layout(location = 0) out vec4 shown;
layout(location = 1) out uvec2 picked;
void main() {
  shown = color;
  picked = uvec2(0u);
}`;

const MODES = { label: 0, height: 1, seen: 2, first: 3, probability: 4, disagreement: 5, contradiction: 6 };

/** Faces in a row of the texture that holds the faces of a tile. */
const FACE_COLUMNS = 1024;

/** Viridis at ten even steps. */
const RAMP = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
              [109, 205, 89], [180, 222, 44], [253, 231, 37]];

/** Time for building meshes in one frame [ms], number of faces to draw, and size of a cell on the screen [pixel]. */
const BUILD_TIME = 40;
const MOST_FACES = 2.5e6;
const CELL_PIXELS = 1.6;

class Renderer {
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL 2");
    Object.assign(this, { canvas, gl, scene });
    this.cubes = program(gl, CUBE_VERTEX, CUBE_FRAGMENT);
    this.lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.meshes = new Map();
    this.detail = CELL_PIXELS;
    this.textures = {
      classColors: texture(gl, scene.classColors),
      maskColors: texture(gl, scene.maskColors, 1024),
      robotColors: texture(gl, scene.robotColors),
      contradictionColors: texture(gl, scene.contradictions.map(({ color }) => color)),
      ramp: texture(gl, RAMP, RAMP.length, gl.LINEAR),
    };
    this.lineBuffer = gl.createBuffer();
    gl.enable(gl.CULL_FACE);
    gl.clearColor(0, 0, 0, 0);
  }

  /** Draw some views side by side: {layer, tick, filter, mode, range, scale, lines}. True if tiles are missing. */
  draw(views, camera) {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const width = Math.floor(canvas.width / views.length);
    const until = performance.now() + BUILD_TIME;
    this.isPartial = false;
    this.isWaiting = false;
    this.numFaces = 0;
    views.forEach((view, k) => {
      gl.viewport(k * width, 0, width, canvas.height);
      this.drawView(view, camera.matrix(width / canvas.height), width, until, false);
    });
    this.adaptDetail();
    this.prune();
    return this.isPartial;
  }

  /** Cube under a place of the canvas [device pixel, from the lower left]: {tile, version, row} or null. */
  pick(views, camera, x, y) {
    const { gl, canvas } = this;
    const width = Math.floor(canvas.width / views.length);
    const k = Math.min(views.length - 1, Math.floor(x / width));
    this.pickTarget ??= pickTarget(gl);
    this.pickTarget.resize(width, canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.pickTarget.framebuffer);
    gl.viewport(0, 0, width, canvas.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x - k * width, y, 1, 1);
    gl.clearBufferuiv(gl.COLOR, 1, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    const drawn = this.drawView(views[k], camera.matrix(width / canvas.height), width, 0, true);
    const found = new Uint32Array(4);
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    gl.readPixels(x - k * width, y, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (found[0] === 0) return null;
    const { tile, version, mesh } = drawn[found[0] - 1];
    return { view: views[k], tile, version, row: mesh.owners[found[1]], word: mesh.words[4 * found[1]] };
  }

  drawView(view, projection, width, until, isPicking) {
    const { gl, scene } = this;
    const drawn = this.chosenTiles(view, projection, until);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.cubes.program);
    const uniforms = this.cubes.uniforms;
    gl.uniformMatrix4fv(uniforms.matrix, false, projection.matrix);
    gl.uniform1i(uniforms.mode, MODES[view.mode]);
    gl.uniform2f(uniforms.heights, view.range[0] - scene.center[2], view.range[1] - scene.center[2]);
    gl.uniform1f(uniforms.scale, view.scale);
    gl.uniform1i(uniforms.isPicking, isPicking ? 1 : 0);
    Object.entries(this.textures).forEach(([name, found], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, found);
      gl.uniform1i(uniforms[name], unit);
    });
    gl.activeTexture(gl.TEXTURE0 + Object.keys(this.textures).length);
    gl.uniform1i(uniforms.faces, Object.keys(this.textures).length);
    drawn.forEach(({ tile, mesh }, number) => {
      if (!mesh.count) return;
      const cell = scene.resolution * 2 ** tile.level;
      const origin = [tile.x, tile.y, tile.z].map((v, k) => v * EDGE * cell - scene.center[k]);
      gl.uniform3f(uniforms.origin, ...origin);
      gl.uniform1f(uniforms.cell, cell);
      gl.uniform1ui(uniforms.tileNumber, number);
      gl.bindTexture(gl.TEXTURE_2D, mesh.texture);
      gl.drawArrays(gl.TRIANGLES, 0, 6 * mesh.count);
      this.numFaces += isPicking ? 0 : mesh.count;
    });
    if (!isPicking) this.drawLines(view.lines, projection, width);
    return drawn;
  }

  /** Tiles to draw with their meshes: near ones fine, far ones coarse, and coarse ones until finer ones are ready. */
  chosenTiles(view, projection, until) {
    const { layer, tick, filter } = view;
    const found = [];
    const visit = (tile) => {
      const version = tile.at(tick);
      const cell = this.scene.resolution * 2 ** tile.level;
      const half = (EDGE * cell) / 2;
      const center = [tile.x, tile.y, tile.z].map((v, k) => v * EDGE * cell + half - this.scene.center[k]);
      const radius = half * Math.sqrt(3);
      if (projection.planes.some((p) => p[0] * center[0] + p[1] * center[1] + p[2] * center[2] + p[3] <
                                        -radius * Math.hypot(p[0], p[1], p[2]))) return true;
      const distance = Math.max(1e-3, Math.hypot(...V.sub(center, projection.eye)) - radius);
      const pixels = (cell * projection.focal * this.canvas.height) / (2 * distance);
      const children = layer.children(tile);
      if (pixels > this.detail && children.length) {
        const length = found.length;
        // All children are visited, so that their meshes are built together.
        if (children.map(visit).every(Boolean)) return true;
        found.length = length;
      }
      if (!version) return true;
      const mesh = this.mesh(tile, version, view, until);
      if (!mesh) return false;
      found.push({ tile, version, mesh });
      return true;
    };
    for (const root of layer.roots) visit(root);
    found.sort((a, b) => a.tile.level - b.tile.level);
    return found;
  }

  /** Mesh of a tile, or null while there is no time to build it or its contents are being loaded. */
  mesh(tile, version, view, until) {
    const key = `${view.layer.name} ${tile.level} ${tile.x} ${tile.y} ${tile.z} ${view.layer.stamp(tile, view.tick)} ${view.filter.key}`;
    let mesh = this.meshes.get(key);
    if (mesh) {
      mesh.used = performance.now();
      return mesh;
    }
    if (performance.now() > until && tile.level < view.layer.coarsest) {
      this.isPartial = true;
      return null;
    }
    const contents = view.layer.contentsOf(version);
    if (!contents) {
      // The page is drawn again when they are loaded.
      this.isWaiting = true;
      return null;
    }
    mesh = this.upload(facesOf(tile, version, contents, view.tick, view.filter, this.scene));
    this.meshes.set(key, mesh);
    return mesh;
  }

  upload({ words, owners }) {
    const { gl } = this;
    const count = owners.length;
    const rows = Math.max(1, Math.ceil(count / FACE_COLUMNS));
    const pixels = new Uint32Array(4 * FACE_COLUMNS * rows);
    pixels.set(words);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, FACE_COLUMNS, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, pixels);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return { texture: made, words, owners, count, used: performance.now() };
  }

  /** Draw coarser where there are too many faces, and finer again where there are few. */
  adaptDetail() {
    const before = this.detail;
    if (this.numFaces > MOST_FACES) this.detail = Math.min(64, this.detail * 1.25);
    // One level more has about four times as many faces.
    else if (this.numFaces < MOST_FACES / 6) this.detail = Math.max(CELL_PIXELS, this.detail / 1.25);
    this.isPartial ||= this.detail !== before;
  }

  /** Remove meshes that were not drawn lately, where there are many. */
  prune() {
    let total = 0;
    for (const mesh of this.meshes.values()) total += mesh.count;
    if (total < 4 * MOST_FACES) return;
    const oldest = [...this.meshes].sort(([, a], [, b]) => a.used - b.used);
    for (const [key, mesh] of oldest) {
      if (total < 2 * MOST_FACES) break;
      total -= mesh.count;
      this.gl.deleteTexture(mesh.texture);
      this.meshes.delete(key);
    }
  }

  /** Draw lines: rows of start, end and colour, 10 numbers each. */
  drawLines(lines, projection, width) {
    const { gl } = this;
    if (!lines.length) return;
    gl.useProgram(this.lines.program);
    gl.uniformMatrix4fv(this.lines.uniforms.matrix, false, projection.matrix);
    gl.uniform2f(this.lines.uniforms.size, width, this.canvas.height);
    gl.uniform1f(this.lines.uniforms.width, 1.6 * (window.devicePixelRatio || 1));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(lines), gl.DYNAMIC_DRAW);
    [[0, 3, 0], [1, 3, 12], [2, 4, 24]].forEach(([place, count, offset]) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, count, gl.FLOAT, false, 40, offset);
      gl.vertexAttribDivisor(place, 1);
    });
    gl.disable(gl.CULL_FACE);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, lines.length / 10);
    gl.enable(gl.CULL_FACE);
    for (const place of [0, 1, 2]) {
      gl.vertexAttribDivisor(place, 0);
      gl.disableVertexAttribArray(place);
    }
  }
}

/** Compiled program and the places of its uniforms. */
function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const uniforms = {};
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(made, k);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { program: made, uniforms };
}

/** Texture of colours 0..255, row by row. */
function texture(gl, colors, columns = 256, filter = gl.NEAREST) {
  const rows = Math.max(1, Math.ceil(colors.length / columns));
  const pixels = new Uint8Array(4 * rows * columns);
  colors.forEach((color, k) => pixels.set([...color, 255], 4 * k));
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, columns, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

/** Framebuffer whose second picture holds the tile and the face of each pixel. */
function pickTarget(gl) {
  const framebuffer = gl.createFramebuffer();
  const parts = [0, 1, 2].map(() => gl.createRenderbuffer());
  let size = [0, 0];
  const resize = (width, height) => {
    if (size[0] === width && size[1] === height) return;
    size = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const formats = [gl.RGBA8, gl.RGBA32UI, gl.DEPTH_COMPONENT24];
    const places = [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1, gl.DEPTH_ATTACHMENT];
    parts.forEach((part, k) => {
      gl.bindRenderbuffer(gl.RENDERBUFFER, part);
      gl.renderbufferStorage(gl.RENDERBUFFER, formats[k], width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, places[k], gl.RENDERBUFFER, part);
    });
    gl.drawBuffers(places.slice(0, 2));
  };
  return { framebuffer, resize };
}
