// Maps as tiles of 32 x 32 x 32 cells on several levels, and the state of a map at a time.

const EDGE = 32;
const NO_TILE = 0xffffffff;
const FREE = 0;
/** Steps to the six neighbours: +x, -x, +y, -y, +z, -z. */
const STEPS = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];

/** Interleaved bits of three coordinates 0..31: the Morton code of a cell in its tile. */
const SPREAD = Uint16Array.from({ length: EDGE }, (_, x) =>
  (x & 1) | ((x & 2) << 2) | ((x & 4) << 4) | ((x & 8) << 6) | ((x & 16) << 8));
const localCode = (x, y, z) => SPREAD[x] | (SPREAD[y] << 1) | (SPREAD[z] << 2);
/** Coordinates of a local Morton code: x + 32 y + 1024 z. */
const CELL_OF_CODE = new Uint16Array(EDGE ** 3);
for (let z = 0; z < EDGE; z++)
  for (let y = 0; y < EDGE; y++)
    for (let x = 0; x < EDGE; x++) CELL_OF_CODE[localCode(x, y, z)] = x | (y << 5) | (z << 10);

/** One number for a tile: level and place, each coordinate in -8192..8191. */
const tileKey = (level, x, y, z) => ((level * 16384 + x + 8192) * 16384 + y + 8192) * 16384 + z + 8192;

class Tile {
  constructor(layer, level, x, y, z) {
    Object.assign(this, { layer, level, x, y, z, versions: [] });
  }

  /** Version at a tick: the last one up to it, or null. */
  at(tick) {
    let found = null;
    for (const version of this.versions) {
      if (version.tick > tick) break;
      found = version;
    }
    return found !== null && (found.cubes !== NO_TILE || found.free !== NO_TILE) ? found : null;
  }
}

/** A map over time. */
class Layer {
  constructor(description, pools) {
    Object.assign(this, { name: description.name, robot: description.robot, kind: description.kind,
                          title: description.title, pools });
    this.tiles = new Map();
    this.contents = new Map();
    this.finest = Infinity;
    this.coarsest = 0;
    const { levels, places, ticks, cubes, team, free } = description.tiles;
    for (let row = 0; row < levels.length; row++) {
      const [x, y, z] = places.subarray(3 * row, 3 * row + 3);
      const key = tileKey(levels[row], x, y, z);
      let tile = this.tiles.get(key);
      if (!tile) this.tiles.set(key, (tile = new Tile(this, levels[row], x, y, z)));
      tile.versions.push({ tick: ticks[row], cubes: cubes[row], team: team[row], free: free[row] });
      this.finest = Math.min(this.finest, levels[row]);
      this.coarsest = Math.max(this.coarsest, levels[row]);
    }
    // All tiles of the coarsest level.
    this.roots = [...this.tiles.values()].filter((tile) => !this.parent(tile));
  }

  tile(level, x, y, z) {
    return this.tiles.get(tileKey(level, x, y, z));
  }

  parent(tile) {
    return this.tile(tile.level + 1, tile.x >> 1, tile.y >> 1, tile.z >> 1);
  }

  children(tile) {
    if (tile.level === 0) return [];
    const found = [];
    for (let k = 0; k < 8; k++) {
      const child = this.tile(tile.level - 1, 2 * tile.x + (k & 1), 2 * tile.y + ((k >> 1) & 1), 2 * tile.z + (k >> 2));
      if (child) found.push(child);
    }
    return found;
  }

  /** Text that differs where a tile or one of its six neighbours differs between two ticks. */
  stamp(tile, tick) {
    if (tile.stamped === tick) return tile.stampText;
    const near = STEPS.map(([dx, dy, dz]) => this.tile(tile.level, tile.x + dx, tile.y + dy, tile.z + dz));
    tile.stampText = [tile, ...near].map((t) => t?.at(tick)?.tick ?? "").join(",");
    tile.stamped = tick;
    return tile.stampText;
  }

  /** Cubes and free runs of a version of a tile, or null while they are being loaded. */
  contentsOf(version) {
    const key = `${version.cubes} ${version.team} ${version.free}`;
    let found = this.contents.get(key);
    if (found) return found;
    const parts = ["cubes", "team", "free"].map((name) =>
      version[name] === NO_TILE ? undefined : this.pools[name].get(version[name]));
    if (parts.includes(null)) return null;
    found = { cubes: parts[0] && withCodes(parts[0]), team: parts[1], free: parts[2] && withStarts(parts[2]) };
    this.contents.set(key, found);
    return found;
  }

  /** State of a cell of a level at its integer coordinates at a tick: {state, label, probability, ...}. */
  lookup(tick, level, cell) {
    const place = cell.map((v) => Math.floor(v / EDGE));
    const tile = this.tile(level, ...place);
    const version = tile && tile.at(tick);
    const contents = version && this.contentsOf(version);
    if (version && !contents) return { state: "loading" };
    if (!contents) return { state: "unknown" };
    const code = localCode(...cell.map((v, k) => v - EDGE * place[k]));
    const row = contents.cubes ? cubeAt(contents.cubes, code) : -1;
    if (row >= 0 && contents.cubes.label[row] !== FREE) return { state: "occupied", ...rowOf(contents, row) };
    const isFree = row >= 0 || (contents.free && holds(contents.free, code));
    return isFree ? { state: "free", ...(row >= 0 ? rowOf(contents, row) : {}) } : { state: "unknown" };
  }
}

/** Values of a cube. */
function rowOf(contents, row) {
  const { cubes, team } = contents;
  return {
    label: cubes.label[row], probability: cubes.probability[row] / 65535, size: 1 << cubes.size[row],
    disagreement: team && team.disagreement[row] / 500, seen: team && team.seen[row],
    first: team && team.first[row], contradiction: team && team.contradiction[row],
  };
}

/** Cubes with their Morton codes in place of steps. */
function withCodes(cubes) {
  return { ...cubes, codes: sums(cubes.steps) };
}

/** Runs with their first codes in place of gaps. */
function withStarts(runs) {
  return { starts: sums(runs.gaps), lengths: runs.lengths };
}

function sums(steps) {
  const codes = new Uint16Array(steps.length);
  let code = 0;
  for (let i = 0; i < steps.length; i++) codes[i] = code += steps[i];
  return codes;
}

/** Last row with a value of at most ``code`` in an ascending array, or -1. */
function lastUpTo(values, code) {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= code) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Row of the cube that contains a cell, or -1. */
function cubeAt(cubes, code) {
  const row = lastUpTo(cubes.codes, code);
  return row >= 0 && code < cubes.codes[row] + (1 << (3 * cubes.size[row])) ? row : -1;
}

function holds(runs, code) {
  const row = lastUpTo(runs.starts, code);
  return row >= 0 && code <= runs.starts[row] + runs.lengths[row];
}
