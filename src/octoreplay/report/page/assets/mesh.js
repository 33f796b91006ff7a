// Exposed faces of the cubes of a tile.

const NUM_CELLS = EDGE ** 3;

/** What is shown of a map: classes, robots, free space, heights [m], and cells that only the contradiction shows. */
class Filter {
  constructor(state, masks) {
    this.hiddenClasses = state.hiddenClasses;
    this.showsContradicted = state.color === "contradiction";
    this.showsFree = state.free;
    this.heights = state.heights;
    const all = state.hiddenRobots.size === 0;
    this.hiddenMasks = masks.map((robots) => !all && robots.length > 0 && robots.every((r) => state.hiddenRobots.has(r)));
    this.key = JSON.stringify([[...state.hiddenClasses], this.showsContradicted, this.showsFree, this.heights,
                               [...state.hiddenRobots]]);
  }

  shows(cubes, team, row) {
    const label = cubes.label[row];
    if (label === FREE ? !this.showsContradicted : this.hiddenClasses.has(label)) return false;
    return !(team && this.hiddenMasks[team.seen[row]]);
  }
}

/** Rows of the cubes of a tile that are shown, and a bit for each cell that they cover. */
function shownCubes(tile, contents, filter, layout) {
  if (!contents.cubes) return { rows: [], bits: null };
  contents.shown ??= new Map();
  let found = contents.shown.get(`${filter.key} ${tile.level} ${tile.z}`);
  if (found) return found;
  const { cubes, team } = contents;
  const cell = layout.resolution * 2 ** tile.level;
  const base = tile.z * EDGE;
  const [low, high] = filter.heights.map((z) => z / cell - base);
  const bits = new Uint32Array(NUM_CELLS / 32);
  const rows = [];
  for (let row = 0; row < cubes.codes.length; row++) {
    if (!filter.shows(cubes, team, row)) continue;
    const z = CELL_OF_CODE[cubes.codes[row]] >> 10;
    const edge = 1 << cubes.size[row];
    if (z + edge <= low || z >= high) continue;
    rows.push(row);
    const code = cubes.codes[row];
    for (let c = code; c < code + edge ** 3; c++) bits[c >> 5] |= 1 << (c & 31);
  }
  found = { rows, bits };
  if (contents.shown.size > 2) contents.shown.clear();
  contents.shown.set(`${filter.key} ${tile.level} ${tile.z}`, found);
  return found;
}

/** Function that says whether a cell of a tile or of its six neighbours is covered: coordinates -1..32. */
function coverage(tile, tick, filter, layout, own) {
  const around = STEPS.map(([dx, dy, dz]) => {
    const next = tile.layer.tile(tile.level, tile.x + dx, tile.y + dy, tile.z + dz);
    const version = next && next.at(tick);
    const contents = version && tile.layer.contentsOf(version);
    return contents ? shownCubes(next, contents, filter, layout).bits : null;
  });
  const isSet = (bits, code) => bits !== null && (bits[code >> 5] >>> (code & 31)) & 1;
  return (x, y, z) => {
    let bits = own;
    if (x === EDGE) [bits, x] = [around[0], 0];
    else if (x < 0) [bits, x] = [around[1], EDGE - 1];
    else if (y === EDGE) [bits, y] = [around[2], 0];
    else if (y < 0) [bits, y] = [around[3], EDGE - 1];
    else if (z === EDGE) [bits, z] = [around[4], 0];
    else if (z < 0) [bits, z] = [around[5], EDGE - 1];
    return isSet(bits, localCode(x, y, z));
  };
}

/** Whether any cell beside the face of a cube is not covered. */
function isExposed(covers, x, y, z, edge, [dx, dy, dz]) {
  const [ax, ay, az] = [dx, dy, dz].map((d, k) => (d > 0 ? [x, y, z][k] + edge : d < 0 ? [x, y, z][k] - 1 : -1));
  for (let i = 0; i < edge; i++)
    for (let j = 0; j < edge; j++) {
      const free = dx ? covers(ax, y + i, z + j) : dy ? covers(x + i, ay, z + j) : covers(x + i, y + j, az);
      if (!free) return true;
    }
  return false;
}

/**
 * Faces of a tile: four numbers each, and the row of its cube, -1 for free space.
 *
 * The first number is x | y << 5 | z << 10 | size << 15 | direction << 18 | label << 21 | free << 29, the second one
 * probability | disagreement << 16, the third one seen | first << 16 | contradiction << 24,
 * and the fourth one 0.
 */
function facesOf(tile, version, contents, tick, filter, layout) {
  const { cubes, team } = contents;
  const { rows, bits } = shownCubes(tile, contents, filter, layout);
  const covers = coverage(tile, tick, filter, layout, bits);
  const [words, owners] = [[], []];
  for (const row of rows) {
    const cell = CELL_OF_CODE[cubes.codes[row]];
    const [x, y, z] = [cell & 31, (cell >> 5) & 31, cell >> 10];
    const size = cubes.size[row];
    const second = cubes.probability[row] | ((team ? team.disagreement[row] : 0) << 16);
    const third = team ? team.seen[row] | (team.first[row] << 16) | (team.contradiction[row] << 24) : 0;
    for (let d = 0; d < 6; d++) {
      if (!isExposed(covers, x, y, z, 1 << size, STEPS[d])) continue;
      words.push(cell | (size << 15) | (d << 18) | (cubes.label[row] << 21), second, third, 0);
      owners.push(row);
    }
  }
  if (filter.showsFree && contents.free) addFreeFaces(tile, contents.free, filter, layout, bits, words, owners);
  return { words: Uint32Array.from(words), owners: Int32Array.from(owners) };
}

/** Add the faces of free cells to cells of this tile that are not free. */
function addFreeFaces(tile, free, filter, layout, bits, words, owners) {
  const isFree = new Uint8Array(NUM_CELLS);
  const cell = layout.resolution * 2 ** tile.level;
  const [low, high] = filter.heights.map((z) => z / cell - tile.z * EDGE);
  for (let run = 0; run < free.starts.length; run++) {
    for (let c = free.starts[run]; c <= free.starts[run] + free.lengths[run]; c++) {
      const z = CELL_OF_CODE[c] >> 10;
      const isCovered = bits !== null && (bits[c >> 5] >>> (c & 31)) & 1;
      if (z + 1 > low && z < high && !isCovered) isFree[CELL_OF_CODE[c]] = 1;
    }
  }
  for (let c = 0; c < NUM_CELLS; c++) {
    if (!isFree[c]) continue;
    const at = [c & 31, (c >> 5) & 31, c >> 10];
    for (let d = 0; d < 6; d++) {
      const [x, y, z] = at.map((v, k) => v + STEPS[d][k]);
      // A face on the border of the tile would be inside the free space of the next tile.
      if (x < 0 || y < 0 || z < 0 || x === EDGE || y === EDGE || z === EDGE) continue;
      if (isFree[x | (y << 5) | (z << 10)]) continue;
      words.push(c | (d << 18) | (1 << 29), 0, 0, 0);
      owners.push(-1);
    }
  }
}
