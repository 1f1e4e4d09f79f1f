// Where samples come from: out of the page itself, or from the server of `pcdata view`, each when it is chosen.

import { bytesOf, inflated } from "./decode.js";

const MOST_LISTED = 200; // names in the list at a time, as the server gives them

/** Samples that the page carries. */
export class Carried {
  constructor(samples) {
    this.samples = samples;
    this.total = samples.length;
    this.listed = samples.map((one, place) => ({ place, name: one.name }));
  }

  async sample(place) {
    return this.samples[place];
  }

  async bytes(cloud) {
    return bytesOf(document.getElementById(cloud.blob).textContent);
  }
}

/** Samples that a server has; what was asked for before and is no longer wanted is given up. */
export class Served {
  constructor(total) {
    this.total = total;
    this.listed = [];
    this.before = 0; // names that fit and come before those listed
    this.matching = total;
    this.wanted = null;
  }

  /** Lists names that hold a text, from the `from`-th of them on. */
  async list(from, text) {
    const asked = `samples?from=${from}&find=${encodeURIComponent(text)}`;
    const found = await (await answer(asked)).json();
    this.listed = found.samples.map(([place, name]) => ({ place, name }));
    this.before = found.from;
    this.matching = found.matching;
  }

  get step() {
    return MOST_LISTED;
  }

  async sample(place) {
    if (this.wanted) this.wanted.abort();
    this.wanted = new AbortController();
    return (await answer(`sample/${place}`, this.wanted.signal)).json();
  }

  async bytes(cloud) {
    return inflated(await (await answer(cloud.blob, this.wanted?.signal)).arrayBuffer());
  }
}

async function answer(address, signal) {
  let told;
  try {
    told = await fetch(address, { signal });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("the server does not answer: has pcdata view ended?");
  }
  if (!told.ok) throw new Error(await told.text());
  return told;
}
