// What stages/viewer/page.py packed into the page.

/** What stands in the page itself. */
async function unpacked(base64) {
  const packed = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return contentsOf(await new Response(stream).arrayBuffer());
}

/** The header and a function from a section's name to its bytes. */
function contentsOf(whole) {
  const length = new DataView(whole).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, length)));
  const section = (name) => {
    const place = header.sections[name];
    return place && new Uint8Array(whole, 4 + length + place[0], place[1]);
  };
  const views = header.views?.map((view) => ({
    ...view, pose: poseOfRows(view.pose), lens: lensOf(view.lens), nearFar: view.near_far,
  }));
  return { ...header, views, section };
}

const floats = (bytes) => new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);

/** Rows of four features out of planes: level after level, feature after feature, of 16 bits low bytes first. */
function interleaved(planes, levels, bytesPerNumber) {
  const table = new Uint8Array(planes.length), perRow = 4 * bytesPerNumber;
  let from = 0;
  for (const { first_row: first, rows } of levels) {
    for (let place = 0; place < perRow; ++place) {
      for (let row = 0, to = first * perRow + place; row < rows; ++row, to += perRow) table[to] = planes[from++];
    }
  }
  return table;
}

/** Bricks as the shader reads them: two words of bits, the empty-space distance, nothing. */
function occupancyTexels(words, emptyDistance) {
  const texels = new Uint32Array(4 * emptyDistance.length);
  const bits = new Uint32Array(words.buffer, words.byteOffset, words.byteLength / 4);
  emptyDistance.forEach((distance, brick) => texels.set([bits[2 * brick], bits[2 * brick + 1], distance], 4 * brick));
  return texels;
}
