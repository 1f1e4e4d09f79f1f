// The page's viewer: which sample, which step of its pipeline, colored by what; picking and measuring.

import { colorsOf, modesOf, toldOf } from "./colors.js";
import { cloudOf } from "./decode.js";
import { Carried, Served } from "./library.js";
import { Stage } from "./stage.js";

const find = (id) => document.getElementById(id);

class Viewer {
  constructor(root, library) {
    this.library = library;
    this.sample = -1; // none yet
    this.shown = null; // its stages
    this.step = 0;
    this.mode = null;
    this.hidden = new Set();
    this.picked = [];
    this.decoded = new Map();
    this.stage = new Stage(root.querySelector("canvas"));
    this.connect();
    this.ready = this.begin();
  }

  get stages() {
    return this.shown ? this.shown.stages : [];
  }

  get said() {
    return this.stages[this.step]?.cloud; // none where a sample could not be read
  }

  connect() {
    find("sample").addEventListener("change", (event) => this.open(this.library.listed[event.target.selectedIndex].place));
    if (find("find")) {
      find("find").addEventListener("input", () => this.list(0));
      find("earlier").addEventListener("click", () => this.list(this.library.before - this.library.step));
      find("later").addEventListener("click", () => this.list(this.library.before + this.library.step));
    }
    find("step").addEventListener("change", (event) => this.go(event.target.selectedIndex));
    find("before").addEventListener("click", () => this.go(this.step - 1));
    find("after").addEventListener("click", () => this.go(this.step + 1));
    find("color").addEventListener("change", (event) => this.paint(event.target.value));
    find("size").addEventListener("input", (event) => {
      this.sized = true; // from now on the reader's size
      this.stage.setSize(Number(event.target.value));
    });
    find("reset").addEventListener("click", () => this.look());
    find("measure").addEventListener("click", () => this.setMeasuring(!this.measuring));
    const canvas = this.stage.canvas;
    let down = null;
    canvas.addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.pick(event.offsetX, event.offsetY);
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    for (const link of document.querySelectorAll("[data-sample]"))
      link.addEventListener("click", () => {
        this.open(Number(link.dataset.sample));
        find("viewer").scrollIntoView({ behavior: "smooth" });
      });
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    const ground = () => this.stage.ground(getComputedStyle(canvas).backgroundColor);
    dark.addEventListener("change", ground);
    ground();
  }

  key(event) {
    const turn = 0.08;
    const done = {
      ArrowLeft: () => this.stage.turn(-turn, 0),
      ArrowRight: () => this.stage.turn(turn, 0),
      ArrowUp: () => this.stage.turn(0, turn),
      ArrowDown: () => this.stage.turn(0, -turn),
      "+": () => this.stage.zoom(0.9),
      "=": () => this.stage.zoom(0.9),
      "-": () => this.stage.zoom(1 / 0.9),
      "[": () => this.go(this.step - 1),
      "]": () => this.go(this.step + 1),
      ",": () => this.open(this.sample - 1),
      ".": () => this.open(this.sample + 1),
      c: () => this.nextColor(),
      m: () => this.setMeasuring(!this.measuring),
      r: () => this.look(),
      Enter: () => this.pick(this.stage.canvas.clientWidth / 2, this.stage.canvas.clientHeight / 2),
    }[event.key];
    if (!done || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    done();
  }

  fill(select, names) {
    select.replaceChildren(
      ...names.map((name) => {
        const option = document.createElement("option");
        option.textContent = name; // as text: names come from files
        return option;
      }),
    );
  }

  async begin() {
    if (this.library.list) await this.list(0);
    else this.fill(find("sample"), this.library.listed.map((one) => one.name));
    await this.open(0);
  }

  /** Lists other names; the sample that is shown stays. */
  async list(from) {
    const text = find("find").value;
    try {
      await this.library.list(Math.max(from, 0), text);
    } catch (error) {
      find("picked").textContent = error.message;
      return;
    }
    if (text !== find("find").value) return; // more was typed meanwhile
    const { listed, before, matching, step } = this.library;
    this.fill(find("sample"), listed.map((one) => one.name));
    this.selectSample();
    find("earlier").disabled = before === 0;
    find("later").disabled = before + step >= matching;
  }

  selectSample() {
    find("sample").selectedIndex = this.library.listed.findIndex((one) => one.place === this.sample);
  }

  async open(sample) {
    if (sample < 0 || sample >= this.library.total) return;
    this.sample = sample;
    this.selectSample();
    try {
      const shown = await this.library.sample(sample);
      if (sample !== this.sample) return; // another one was chosen meanwhile
      this.shown = shown;
      this.tellSample(shown);
      this.fill(find("step"), this.stages.map((one) => one.caption));
      this.shownFrame = null;
      if (this.stages.length) await this.go(this.stages.length - 1);
      else this.stage.clear();
    } catch (error) {
      if (error.name !== "AbortError") find("picked").textContent = error.message;
    }
  }

  /** Shows the pictures of a sample that a server sent. */
  tellSample(shown) {
    const box = find("pictures");
    if (!box) return;
    document.querySelector("#viewer").previousElementSibling.textContent = shown.name;
    const figures = shown.pictures.map(({ caption, uri }) => {
      const figure = document.createElement("figure");
      const image = document.createElement("img");
      const told = document.createElement("figcaption");
      image.src = uri;
      image.width = 320;
      image.alt = told.textContent = caption; // as text
      figure.append(image, told);
      return figure;
    });
    const problem = document.createElement("p");
    problem.className = "fail";
    problem.textContent = shown.problem;
    box.replaceChildren(...(shown.problem ? [problem] : []), ...figures);
    find("picked").textContent = "";
    if (!shown.stages.length) find("counted").textContent = "";
  }

  async decode(cloud) {
    if (!this.decoded.has(cloud.blob)) {
      this.decoded.set(cloud.blob, cloudOf(await this.library.bytes(cloud), cloud));
      // Samples that were looked at long ago are decoded anew.
      if (this.decoded.size > 12) this.decoded.delete(this.decoded.keys().next().value);
    }
    return this.decoded.get(cloud.blob);
  }

  async go(step) {
    if (step < 0 || step >= this.stages.length) return;
    this.step = step;
    find("step").selectedIndex = step;
    find("before").disabled = step === 0;
    find("after").disabled = step === this.stages.length - 1;
    const said = this.said;
    const cloud = await this.decode(said);
    if (said !== this.said) return; // another one was asked for meanwhile
    this.cloud = cloud;
    const modes = modesOf(said);
    this.fill(find("color"), modes);
    const mode = modes.includes(this.mode) ? this.mode : modes[0];
    const lines = this.stages[step].lines;
    this.stage.setLines(lines, (name) => !this.hidden.has(name));
    this.listLines(lines);
    const { colors, legend } = colorsOf(this.cloud, said, mode, said.up);
    if (!this.sized) find("size").value = said.count < 6000 ? 5 : said.count < 40000 ? 3 : 2;
    this.stage.show(this.cloud.positions, colors, Number(find("size").value));
    this.tell(mode, legend);
    this.picked = [];
    this.stage.setMark([], 0);
    find("picked").textContent = "";
    const part = said.count < said.total ? `${said.count.toLocaleString("en")} of ` : "";
    find("counted").textContent =
      `${part}${said.total.toLocaleString("en")} points in '${said.frame}' [${said.unit}], ` +
      `drawn to ±${(1000 * said.bound).toPrecision(2)} ${said.unit === "m" ? "mm" : "thousandths"}`;
    // A step that keeps the frame is seen from where the one before was.
    const frame = `${said.frame} ${said.unit}`;
    if (frame !== this.shownFrame) this.look();
    this.shownFrame = frame;
  }

  look() {
    if (!this.said) return;
    const { lower, upper, up, toward } = this.said.view;
    this.stage.look(lower, upper, up, toward);
  }

  paint(mode) {
    if (!this.said) return;
    this.mode = mode;
    find("color").value = mode;
    const { colors, legend } = colorsOf(this.cloud, this.said, mode, this.said.up);
    this.stage.paint(colors);
    this.tell(mode, legend);
  }

  nextColor() {
    if (!this.said) return;
    const select = find("color");
    this.paint(select.options[(select.selectedIndex + 1) % select.options.length].value);
  }

  tell(mode, legend) {
    find("color").value = mode;
    const box = find("legend");
    box.replaceChildren();
    if (!legend) return;
    if (legend.entries) {
      for (const { name, color } of legend.entries.slice(0, 24)) {
        const entry = document.createElement("span");
        const swatch = document.createElement("i");
        swatch.style.backgroundColor = color;
        entry.append(swatch, name);
        box.append(entry);
      }
      if (legend.entries.length > 24) box.append(`and ${legend.entries.length - 24} more`);
      return;
    }
    const ramp = document.createElement("b");
    box.append(legend.low.toPrecision(3), ramp, legend.high.toPrecision(3));
    if (legend.none) box.append("gray: none");
  }

  listLines(lines) {
    find("lines").replaceChildren(
      ...lines.map(({ name }) => {
        const label = document.createElement("label");
        const box = document.createElement("input");
        box.type = "checkbox";
        box.checked = !this.hidden.has(name);
        box.addEventListener("change", () => {
          if (box.checked) this.hidden.delete(name);
          else this.hidden.add(name);
          this.stage.showLine(name, box.checked);
        });
        label.append(box, name);
        return label;
      }),
    );
  }

  setMeasuring(on) {
    this.measuring = on;
    find("measure").setAttribute("aria-pressed", String(on));
    this.picked = [];
    this.stage.setMark([], 0);
    find("picked").textContent = on ? "pick two points" : "";
  }

  place(row) {
    return Array.from(this.cloud.positions.subarray(3 * row, 3 * row + 3));
  }

  pick(x, y) {
    const row = this.stage.pick(x, y);
    if (row < 0) {
      find("picked").textContent = "no point there";
      return row;
    }
    this.picked = this.measuring && this.picked.length === 1 ? [this.picked[0], row] : [row];
    const places = this.picked.map((one) => this.place(one));
    const { lower, upper } = this.said.view;
    this.stage.setMark(places, 0.01 * Math.hypot(...upper.map((high, a) => high - lower[a])));
    const at = places[places.length - 1].map((value) => value.toFixed(4)).join(" ");
    const said = [`(${at}) ${this.said.unit}`];
    for (const field of Object.values(this.cloud.fields)) said.push(`${field.name} ${toldOf(field, row)}`);
    if (places.length === 2) {
      const apart = Math.hypot(...places[0].map((value, a) => value - places[1][a]));
      said.unshift(this.said.unit === "m" ? `${(1000 * apart).toFixed(1)} mm apart` : `${apart.toPrecision(4)} apart`);
    }
    find("picked").textContent = said.join("; ");
    return row;
  }
}

const index = find("pcdata-index");
const served = find("pcdata-served");
const library = served ? new Served(Number(served.textContent)) : new Carried(index ? JSON.parse(index.textContent) : []);
if (library.total) {
  try {
    window.pcdata = new Viewer(find("viewer"), library);
  } catch (error) {
    find("picked").textContent = `This browser cannot draw in three dimensions (${error.message}); all else is on this page.`;
  }
}
