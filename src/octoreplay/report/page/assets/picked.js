// Answer to a click: the cell, and what each map knows of it.

/** Short text of the state of a cell. */
function stateText(found, classes) {
  if (found.state !== "occupied") return [found.state, ""];
  return [classes[found.label], found.probability.toFixed(4)];
}

/**
 * Answer for a picked face: point [m], cell, and rows (map, state, probability) of all maps at the tick.
 */
function answerOf(page, hit) {
  const { scene, layers } = page;
  const { tile, version, row, word } = hit;
  const cell = row >= 0 ? CELL_OF_CODE[tile.layer.contentsOf(version).cubes.codes[row]] : word & 0x7fff;
  const size = row >= 0 ? 1 << tile.layer.contentsOf(version).cubes.size[row] : 1;
  const edge = scene.resolution * 2 ** tile.level;
  const corner = [cell & 31, (cell >> 5) & 31, cell >> 10].map((v, k) => (v + EDGE * [tile.x, tile.y, tile.z][k]) * edge);
  const point = corner.map((v) => v + (size * edge) / 2);
  const rows = [...layers.values()].map((layer) => {
    // A cell of a coarse tile is compared with the cells of that level.
    const level = Math.max(tile.level, layer.finest);
    const cells = point.map((v) => Math.floor(v / (scene.resolution * 2 ** level)));
    return { layer, ...layer.lookup(page.storedAt(page.state.row), level, cells) };
  });
  return { point, edge: size * edge, rows };
}

/** Show an answer in the panel. */
function showAnswer(page, answer) {
  const panel = document.getElementById("picked");
  if (!answer) {
    panel.replaceChildren(textElement("p", "No cell there."));
    return;
  }
  const { scene } = page;
  const team = answer.rows.find(({ layer }) => layer.kind === "team");
  const place = answer.point.map((v) => v.toFixed(2)).join(", ");
  const parts = [textElement("p", `cell at ${place} m, edge ${Number(answer.edge.toPrecision(4))} m`)];
  if (team.state === "occupied" && team.disagreement !== undefined) {
    parts.push(textElement("p", `largest difference of two robots' log-odds: ${shortNumber(team.disagreement)}`));
  }
  if (team.seen) {
    const names = scene.masks[team.seen].map((robot) => scene.robots[robot].id).join(", ");
    parts.push(textElement("p", `seen by ${names}`));
  }
  if (team.first) parts.push(textElement("p", `first seen by ${firstName(scene, team.first)}`));
  if (team.contradiction) parts.push(textElement("p", `robots' scans: ${scene.contradictions[team.contradiction].name}`));
  const table = document.createElement("table");
  const head = table.createTHead().insertRow();
  for (const title of ["map", "state", "probability"]) {
    head.append(Object.assign(textElement("th", title), { scope: "col" }));
  }
  const body = table.createTBody();
  for (const { layer, ...found } of answer.rows) {
    const [state, probability] = stateText(found, scene.classNames);
    const line = body.insertRow();
    line.append(Object.assign(textElement("th", layerTitle(layer)), { scope: "row" }));
    line.append(textElement("td", state));
    line.append(Object.assign(textElement("td", probability), { className: "number" }));
  }
  panel.replaceChildren(...parts, table);
}

function firstName(scene, first) {
  return first === 255 ? "several robots at once" : scene.robots[first - 1].id;
}

function textElement(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
