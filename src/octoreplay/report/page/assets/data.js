// Reading of the page's data: the header, which is JSON, and the columns, which are one block of compressed arrays.

const header = JSON.parse(document.getElementById("header").textContent);

/** Bytes of a base64 text. */
function bytesOf(text) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** Contents of a gzip member. */
async function unpacked(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const arrayTypes = { Uint8Array, Uint16Array, Uint32Array, Int16Array, Int32Array, Float32Array, Float64Array };

/** Array at a place of the block: its bytes are grouped by their position in a number. */
function arrayAt(block, place) {
  const { type, offset, count } = place;
  const array = new arrayTypes[type](count);
  const size = array.BYTES_PER_ELEMENT;
  if (size === 1) return block.subarray(offset, offset + count);
  const bytes = new Uint8Array(array.buffer);
  for (let k = 0; k < size; k++) {
    const start = offset + k * count;
    for (let i = 0, j = k; i < count; i++, j += size) bytes[j] = block[start + i];
  }
  return array;
}

/** Contents of tiles, each stored once: columns, and the first row of each contents. */
class Pool {
  constructor(columns) {
    this.columns = columns;
  }

  /** Columns of one contents, or null while they are being loaded. */
  get(index) {
    const [start, end] = [this.columns.starts[index], this.columns.starts[index + 1]];
    const found = {};
    for (const [name, values] of Object.entries(this.columns)) {
      if (name !== "starts") found[name] = values.subarray(start, end);
    }
    return found;
  }
}

/** Contents of tiles that a server sends when they are wanted. */
class RemotePool {
  constructor(name, onLoad) {
    this.name = name;
    this.onLoad = onLoad;
    this.loaded = new Map();
    this.wanted = new Set();
    this.isLoading = false;
  }

  get(index) {
    const found = this.loaded.get(index);
    if (found) return found;
    this.wanted.add(index);
    if (!this.isLoading) {
      this.isLoading = true;
      setTimeout(() => this.load(), 0);
    }
    return null;
  }

  async load() {
    const indices = [...this.wanted].filter((index) => !this.loaded.has(index)).slice(0, 256);
    this.wanted.clear();
    if (indices.length) {
      try {
        const answer = await fetch(`tiles/${this.name}?ids=${indices.join(",")}`);
        if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
        const places = JSON.parse(answer.headers.get("X-Columns"));
        const block = await unpacked(new Uint8Array(await answer.arrayBuffer()));
        const columns = {};
        for (const [name, place] of Object.entries(places)) columns[name] = arrayAt(block, place);
        const pool = new Pool(columns);
        indices.forEach((index, row) => this.loaded.set(index, pool.get(row)));
      } catch (error) {
        showProblem(`The map cannot be loaded: ${error.message}. Is 'octoreplay view' still running?`);
        indices.forEach((index) => this.wanted.add(index));
        setTimeout(() => this.load(), 3000);
        return;
      }
    }
    this.isLoading = false;
    this.onLoad();
  }
}

/** Load everything but the tiles of a served page: arrays by path in the header, and the pools. */
async function loadData(onLoad) {
  const block = await unpacked(
    header.served ? new Uint8Array(await (await fetch("columns")).arrayBuffer())
                  : bytesOf(document.getElementById("columns").textContent),
  );
  const isPlace = (value) => value !== null && typeof value === "object" && "offset" in value && "count" in value;
  const withArrays = (value) => {
    if (isPlace(value)) return arrayAt(block, value);
    if (Array.isArray(value)) return value.map(withArrays);
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([name, part]) => [name, withArrays(part)]));
  };
  const data = withArrays(header);
  for (const name of ["cubes", "team", "free"]) {
    data.pools[name] = header.served ? new RemotePool(name, onLoad) : new Pool(data.pools[name]);
  }
  return data;
}
