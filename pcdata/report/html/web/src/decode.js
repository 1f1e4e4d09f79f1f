// From the bytes that pcdata/report/html/packing.py makes to arrays: columns one after another, every column the
// differences from row to row, all deflated.

export async function bytesOf(base64) {
  const text = atob(base64);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  return inflated(packed);
}

export async function inflated(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const WIDTHS = { uint8: [Uint8Array, 1], uint16: [Uint16Array, 2], uint32: [Uint32Array, 4] };

/** Returns the columns of a field, each with `count` numbers. */
function columns(bytes, offset, type, num, count) {
  const [array, width] = WIDTHS[type];
  const found = [];
  for (let c = 0; c < num; c++) {
    const start = offset + c * count * width;
    const column = new array(bytes.buffer.slice(start, start + count * width)); // slice: offsets need not be aligned
    for (let i = 1; i < count; i++) column[i] += column[i - 1]; // wraps as the differences did
    found.push(column);
  }
  return found;
}

/** Returns {positions: Float32Array, fields: {name: {...field, columns}}} of a cloud as its description says. */
export function cloudOf(bytes, said) {
  const { count, lower, step } = said;
  const axes = columns(bytes, said.offset, "uint16", 3, count);
  const positions = new Float32Array(3 * count);
  for (let a = 0; a < 3; a++)
    for (let i = 0; i < count; i++) positions[3 * i + a] = lower[a] + step[a] * axes[a][i];
  const fields = {};
  for (const field of said.fields)
    fields[field.name] = { ...field, columns: columns(bytes, field.offset, field.type, field.num, count) };
  return { positions, fields };
}
