// What a point may be colored by, and how.

// Tableau-like hues that stay apart on dark and on light ground; -1 (no label) is gray.
const PALETTE = [
  0x4269d0, 0xefb118, 0xff725c, 0x6cc5b0, 0x3ca951, 0xff8ab7, 0xa463f2, 0x97bbf5, 0x9c6b4e, 0xe15759, 0x76b7b2, 0xedc948,
];
const NONE = 0x9498a0;
// Viridis at nine places (van der Walt and Smith 2015).
const VIRIDIS = [
  [68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99],
  [170, 220, 50], [253, 231, 37],
];

export const HEIGHT = "height";
export const DEPTH = "distance";

export function modesOf(said) {
  const modes = said.fields.filter((field) => field.kind !== "pixel").map((field) => field.name);
  return [...modes, HEIGHT, DEPTH];
}

function viridis(share, out, at) {
  const place = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(place), VIRIDIS.length - 2);
  for (let c = 0; c < 3; c++) out[at + c] = VIRIDIS[low][c] + (place - low) * (VIRIDIS[low + 1][c] - VIRIDIS[low][c]);
}

function hue(value, out, at) {
  const color = value < 0 ? NONE : PALETTE[value % PALETTE.length];
  out[at] = color >> 16;
  out[at + 1] = (color >> 8) & 255;
  out[at + 2] = color & 255;
}

/** Numbers of a scalar mode for every point, or null. */
export function scalarOf(cloud, said, mode, up) {
  const { positions } = cloud;
  const values = new Float32Array(said.count);
  if (mode === HEIGHT) {
    for (let i = 0; i < said.count; i++)
      values[i] = up[0] * positions[3 * i] + up[1] * positions[3 * i + 1] + up[2] * positions[3 * i + 2];
    return values;
  }
  if (mode === DEPTH) {
    for (let i = 0; i < said.count; i++)
      values[i] = Math.hypot(positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]);
    return values;
  }
  const field = cloud.fields[mode];
  if (!field || field.kind !== "scalar") return null;
  for (let i = 0; i < said.count; i++) {
    const level = field.columns[0][i];
    values[i] = level === field.none ? NaN : field.low + field.step * level;
  }
  return values;
}

/** Returns {colors: Uint8Array, legend: {low, high} | {entries} | null}. */
export function colorsOf(cloud, said, mode, up) {
  const colors = new Uint8Array(3 * said.count);
  const scalar = scalarOf(cloud, said, mode, up);
  if (scalar) {
    // From the 1st to the 99th percentile: one stray point does not take all the colors.
    const sorted = scalar.filter((value) => !Number.isNaN(value)).sort();
    const at = (share) => (sorted.length ? sorted[Math.round(share * (sorted.length - 1))] : 0);
    const [low, high] = [at(0.01), at(0.99)];
    const span = high > low ? high - low : 1;
    for (let i = 0; i < said.count; i++) {
      if (Number.isNaN(scalar[i])) hue(-1, colors, 3 * i);
      else viridis((scalar[i] - low) / span, colors, 3 * i);
    }
    return { colors, legend: { low, high, none: sorted.length < said.count } };
  }
  const field = cloud.fields[mode];
  if (field.kind === "category") {
    const entries = field.values.map((value, place) => {
      const sample = [0, 0, 0];
      hue(value, sample, 0);
      return { name: field.names ? field.names[place] : String(value), color: `rgb(${sample.join(",")})` };
    });
    const [column] = field.columns;
    for (let i = 0; i < said.count; i++) hue(field.values[column[i]], colors, 3 * i);
    return { colors, legend: { entries } };
  }
  for (let c = 0; c < 3; c++) for (let i = 0; i < said.count; i++) colors[3 * i + c] = field.columns[c][i];
  return { colors, legend: null };
}

/** What a field says of one point, as text. */
export function toldOf(field, i) {
  if (field.kind === "category") {
    const place = field.columns[0][i];
    return field.names ? field.names[place] : String(field.values[place]);
  }
  if (field.kind === "scalar") {
    const level = field.columns[0][i];
    return level === field.none ? "none" : (field.low + field.step * level).toPrecision(4);
  }
  if (field.kind === "normal") return field.columns.map((c) => ((c[i] - 127.5) / 127.5).toFixed(2)).join(" ");
  if (field.kind === "pixel") {
    const [height, width] = field.size;
    const pixel = field.columns[0][i];
    const inView = pixel % (height * width);
    const view = field.views > 1 ? `view ${Math.floor(pixel / (height * width))}, ` : "";
    return `${view}column ${inView % width}, row ${Math.floor(inView / width)}`;
  }
  return field.columns.map((c) => c[i]).join(" ");
}
