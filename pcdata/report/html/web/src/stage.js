// The canvas: a cloud, lines around it, a camera that goes around them; and which point lies under a place.

import {
  BufferAttribute, BufferGeometry, Color, ColorManagement, LinearSRGBColorSpace, LineBasicMaterial, LineSegments,
  Matrix4, PerspectiveCamera, Points, PointsMaterial, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

ColorManagement.enabled = false; // colors are shown as the camera gave them
const REACH = 8; // pixels around the pointer in which a point is picked
const MOST_TURNED = 50000; // points that a processor draws fluently
const STILL = 250; // milliseconds without a turn after which all points are drawn

function rendererOf(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

/** Whether the processor draws, as there is no graphics card. */
function drawsSlowly() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const slow = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(rendererOf(gl));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return slow;
}

/** Every k-th of the rows of a matrix with three columns. */
function everyKth(values, k) {
  const some = new values.constructor(3 * Math.ceil(values.length / 3 / k));
  for (let from = 0, to = 0; from < values.length; from += 3 * k)
    for (let a = 0; a < 3; a++) some[to++] = values[from + a];
  return some;
}

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.slow = drawsSlowly();
    // Four samples a pixel cost a processor three quarters of its frames, and only lines look smoother.
    this.renderer = new WebGLRenderer({ canvas, antialias: !this.slow, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(45, 1, 0.001, 1000);
    this.points = null;
    this.fewer = null; // of them, drawn while turning where all are too many
    this.step = 1; // every so many-th point is one of them
    this.lines = new Map();
    this.mark = null;
    this.drawn = 0; // frames
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  get rendererName() {
    return rendererOf(this.renderer.getContext());
  }

  ground(color) {
    this.scene.background = new Color(color);
    this.request();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.request();
  }

  request() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
    this.drawn++;
  }

  /** Draws fewer points until the view has been still for a moment. */
  moves() {
    clearTimeout(this.stills);
    this.setTurning(true);
    this.stills = setTimeout(() => this.setTurning(false), STILL);
  }

  setTurning(turning) {
    if (this.fewer) {
      this.fewer.visible = turning;
      this.points.visible = !turning;
    }
    this.request();
  }

  /** Draws nothing. */
  clear() {
    for (const points of [this.points, this.fewer]) if (points) this.remove(points);
    this.points = this.fewer = null;
    this.setLines([], () => false);
    this.setMark([], 0);
  }

  show(positions, colors, size) {
    for (const points of [this.points, this.fewer]) if (points) this.remove(points);
    this.fewer = null;
    this.step = this.slow ? Math.ceil(positions.length / 3 / MOST_TURNED) : 1;
    this.points = this.added(positions, colors);
    if (this.step > 1) {
      this.fewer = this.added(everyKth(positions, this.step), everyKth(colors, this.step));
      this.fewer.visible = false;
    }
    this.setSize(size);
  }

  added(positions, colors) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3));
    geometry.setAttribute("color", new BufferAttribute(colors, 3, true));
    const points = new Points(geometry, new PointsMaterial({ sizeAttenuation: false, vertexColors: true }));
    this.scene.add(points);
    return points;
  }

  remove(points) {
    this.scene.remove(points);
    points.geometry.dispose();
    points.material.dispose();
  }

  paint(colors) {
    this.points.geometry.setAttribute("color", new BufferAttribute(colors, 3, true));
    if (this.fewer) this.fewer.geometry.setAttribute("color", new BufferAttribute(everyKth(colors, this.step), 3, true));
    this.request();
  }

  setSize(size) {
    if (this.points) this.points.material.size = size;
    if (this.fewer) this.fewer.material.size = size * Math.min(Math.sqrt(this.step), 2); // they cover as much
    this.request();
  }

  /** Replaces all lines: [{name, color, segments: [x, y, z, ...]}]. */
  setLines(lines, visible) {
    for (const line of this.lines.values()) {
      this.scene.remove(line);
      line.geometry.dispose();
    }
    this.lines.clear();
    for (const { name, color, segments } of lines) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(Float32Array.from(segments), 3));
      const line = new LineSegments(geometry, new LineBasicMaterial({ color }));
      line.visible = visible(name);
      this.lines.set(name, line);
      this.scene.add(line);
    }
    this.request();
  }

  showLine(name, visible) {
    if (this.lines.has(name)) this.lines.get(name).visible = visible;
    this.request();
  }

  /** Draws a cross at each place and a line between two. */
  setMark(places, size) {
    if (this.mark) this.scene.remove(this.mark);
    this.mark = null;
    if (places.length) {
      const ends = [];
      for (const place of places)
        for (let a = 0; a < 3; a++)
          for (const sign of [-1, 1]) ends.push(...place.map((x, b) => (a === b ? x + sign * size : x)));
      if (places.length === 2) ends.push(...places[0], ...places[1]);
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(Float32Array.from(ends), 3));
      this.mark = new LineSegments(geometry, new LineBasicMaterial({ color: 0xff3b6b, depthTest: false }));
      this.mark.renderOrder = 1;
      this.scene.add(this.mark);
    }
    this.request();
  }

  /** Looks at a box from where `toward` points, with `up` upward. */
  look(lower, upper, up, toward) {
    const center = new Vector3(...lower).add(new Vector3(...upper)).multiplyScalar(0.5);
    const radius = Math.max(new Vector3(...upper).distanceTo(new Vector3(...lower)) / 2, 1e-6);
    if (this.controls) this.controls.dispose();
    this.camera.up.set(...up);
    this.camera.near = radius / 200;
    this.camera.far = radius * 200;
    this.resize(); // sets the shape of the image
    const back = new Vector3(...toward).normalize();
    this.camera.position.copy(center).addScaledVector(back, this.distance(center, lower, upper, up, back));
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.target.copy(center);
    this.controls.update();
    this.controls.addEventListener("change", () => this.moves());
    this.request();
  }

  /** From how far all corners of a box are inside the image, with a margin. */
  distance(center, lower, upper, up, back) {
    const right = new Vector3(...up).cross(back).normalize();
    const above = back.clone().cross(right);
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360) / 1.1;
    let far = 1e-6;
    for (let corner = 0; corner < 8; corner++) {
      const at = new Vector3(...[0, 1, 2].map((a) => (corner & (1 << a) ? upper : lower)[a])).sub(center);
      const aside = Math.max(Math.abs(at.dot(right)) / this.camera.aspect, Math.abs(at.dot(above)));
      far = Math.max(far, at.dot(back) + aside / tangent);
    }
    return far;
  }

  turn(around, above) {
    const { controls, camera } = this;
    const away = camera.position.clone().sub(controls.target);
    away.applyAxisAngle(camera.up, around);
    const side = new Vector3().crossVectors(away, camera.up).normalize();
    const raised = away.clone().applyAxisAngle(side, above);
    if (Math.abs(raised.angleTo(camera.up) - Math.PI / 2) < 1.5) away.copy(raised); // not over the pole
    camera.position.copy(controls.target).add(away);
    controls.update();
    this.request();
  }

  zoom(factor) {
    const { controls, camera } = this;
    camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
    controls.update();
    this.request();
  }

  /** Where a point is drawn: [x, y] in CSS pixels of the canvas. */
  drawnAt(place) {
    this.camera.updateMatrixWorld(); // it may have been moved since the last frame
    const at = new Vector3(...place).project(this.camera);
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight];
  }

  /** The row of the nearest point that is drawn within reach of a place in CSS pixels; -1 where there is none. */
  pick(x, y) {
    if (!this.points) return -1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.camera.updateMatrixWorld();
    const m = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse).elements;
    const p = this.points.geometry.getAttribute("position").array;
    let best = -1;
    let bestCost = Infinity;
    for (let i = 0; i < p.length; i += 3) {
      const w = m[3] * p[i] + m[7] * p[i + 1] + m[11] * p[i + 2] + m[15];
      if (w <= 0) continue;
      const dx = ((m[0] * p[i] + m[4] * p[i + 1] + m[8] * p[i + 2] + m[12]) / w + 1) * 0.5 * width - x;
      const dy = (1 - (m[1] * p[i] + m[5] * p[i + 1] + m[9] * p[i + 2] + m[13]) / w) * 0.5 * height - y;
      const off = Math.hypot(dx, dy);
      if (off > REACH) continue;
      // Of what lies under the pointer the nearest to the eye; beside it, a point loses one per cent for each pixel.
      const cost = w * (1 + 0.01 * off);
      if (cost < bestCost) [best, bestCost] = [i / 3, cost];
    }
    return best;
  }

  /**
   * Frames per second while turning around once, drawn one after another without waiting for the screen; of all points,
   * or of those that are drawn while somebody turns.
   */
  async measure(frames = 60, all = true) {
    const gl = this.renderer.getContext();
    const pixel = new Uint8Array(4);
    const begun = performance.now();
    for (let i = 0; i < frames; i++) {
      this.turn((2 * Math.PI) / frames, 0);
      this.setTurning(!all);
      this.draw();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits until it is drawn
    }
    return (1000 * frames) / (performance.now() - begun);
  }
}
