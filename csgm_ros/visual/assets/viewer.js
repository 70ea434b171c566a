// The interactive view of the report: two clouds, their graphs and every pose that was in question.
// Points are stored so that any first part of them is an even sample: while something moves, as many are drawn as
// the machine draws in a twenty-fifth of a second, and all of them once it rests.
'use strict';

const FRAME = 40; // milliseconds that a frame may take while something moves
const REST = 180; // milliseconds of stillness after which everything is drawn
const APART = 2.7; // widths of both clouds from which the two are seen beside each other
const FEW = 300000; // points of both clouds below which they are drawn larger than two pixels
const GLIDE = 500; // milliseconds from one pose to another
const MODES = { tint: 0, own: 1, error: 2, supervoxels: 3 };

const VERTEX = `
  attribute vec3 own;
  attribute float error;
  attribute float label;
  attribute float light;
  uniform float size, mode, parity, cells, half_slab, depth;
  uniform vec3 tint, slab_axis;
  uniform float slab_at;
  uniform bool has_own;
  uniform vec3 palette[${PALETTE_SIZE()}];
  varying vec3 shade;
  vec3 ramp(float e) { // blue, green, yellow, red; grey where farther than the ramp reaches
    if (e > 0.995) return vec3(0.55);
    return clamp(vec3(2.2 * e - 0.35, 1.35 - 2.2 * abs(e - 0.42), 0.95 - 3.2 * e), 0.0, 1.0);
  }
  void main() {
    vec4 world = modelMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * viewMatrix * world;
    gl_PointSize = size;
    if (mode < 0.5) shade = tint * light;
    else if (mode < 1.5) shade = has_own ? own : tint * light;
    else if (mode < 2.5) shade = ramp(error);
    else shade = label > 254.5 ? vec3(0.75) : palette[int(mod(label, float(${PALETTE_SIZE()})))];
    shade = mix(shade, vec3(1.0), 0.4 * clamp(0.5 * (gl_Position.w - depth) + 0.5, 0.0, 1.0));
    bool hidden = half_slab > 0.0 && abs(dot(world.xyz, slab_axis) - slab_at) > half_slab;
    if (cells > 0.0) {
      vec3 cell = floor(world.xyz * cells);
      hidden = hidden || abs(mod(cell.x + cell.y + cell.z, 2.0) - parity) > 0.5;
    }
    if (hidden) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  }`;
const FRAGMENT = `
  varying vec3 shade;
  uniform bool round;
  void main() {
    if (round && length(gl_PointCoord - 0.5) > 0.5) discard;
    gl_FragColor = vec4(shade, 1.0);
  }`;

function PALETTE_SIZE() {
  return 64;
}

/** The arrays of the page by name: gzip in base64, words cut into planes of bytes so that they compress. */
async function unpack(manifest) {
  const packed = Uint8Array.from(atob(document.getElementById('arrays').textContent.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const arrays = {};
  for (const [name, { offset, length, wide }] of Object.entries(manifest.arrays)) {
    if (!wide) arrays[name] = bytes.subarray(offset, offset + length);
    else {
      const words = new Uint16Array(length);
      for (let i = 0; i < length; i++) words[i] = bytes[offset + i] | (bytes[offset + length + i] << 8);
      arrays[name] = words;
    }
  }
  return arrays;
}

class View {
  constructor(canvas, manifest, arrays) {
    Object.assign(this, { canvas, manifest, arrays });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xffffff);
    this.camera = new THREE.PerspectiveCamera(manifest.field, 1, 0.01, 100);
    this.state = { pose: manifest.start, color: 'tint', layers: {}, cells: 0, slab: -1, slab_at: 0, size: 2, apart: false };
    this.side = 'start';
    this.parts = {};
    for (const name of ['source', 'target']) this.addCloud(name, manifest.clouds[name]);
    if (manifest.graphs) this.addGraphs(manifest.graphs);
    const total = this.parts.source.count + this.parts.target.count; // few points are drawn larger: surfaces stay closed
    this.state.size = Math.min(4, Math.max(2, Math.round(2 * Math.sqrt(FEW / total))));
    this.matrix = this.matrixOf(this.state.pose);
    this.budget = Infinity;
    this.controls = new THREE.TrackballControls(this.camera, canvas);
    Object.assign(this.controls, { rotateSpeed: 3, zoomSpeed: 1.2, panSpeed: 0.6, staticMoving: true });
    this.until = 0;
    for (const kind of ['pointerdown', 'pointermove', 'pointerup', 'wheel', 'touchmove'])
      canvas.addEventListener(kind, (event) => (kind !== 'pointermove' || event.buttons) && this.wake(), { passive: true });
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
    this.look('start');
    this.apply();
  }

  addCloud(name, cloud) {
    const words = this.arrays[cloud.positions], count = words.length / 3;
    const positions = new Float32Array(words.length);
    for (let i = 0; i < words.length; i++) positions[i] = cloud.origin[i % 3] + cloud.step * words[i];
    const geometry = new THREE.BufferGeometry();
    const bytes = (key, width) => new THREE.BufferAttribute(this.arrays[key] || new Uint8Array(count * width), width, width > 1);
    geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
    geometry.setAttribute('own', bytes(cloud.colors, 3));
    geometry.setAttribute('label', bytes(cloud.labels, 1));
    geometry.setAttribute('light', new THREE.BufferAttribute(this.arrays[cloud.light], 1, true));
    geometry.setAttribute('error', new THREE.BufferAttribute(new Uint8Array(count), 1, true));
    const material = this.material(cloud.tint, name === 'source' ? 0 : 1, Boolean(cloud.colors));
    this.add(name, new THREE.Points(geometry, material)).count = count;
  }

  material(tint, parity, hasOwn) {
    const palette = this.manifest.palette.map((c) => new THREE.Vector3(...c));
    const values = {
      size: 2, mode: 0, parity, cells: 0, half_slab: 0, slab_at: 0, depth: 3, tint: new THREE.Vector3(...tint), has_own: hasOwn,
      slab_axis: new THREE.Vector3(1, 0, 0), round: false, palette,
    };
    const uniforms = Object.fromEntries(Object.entries(values).map(([key, value]) => [key, { value }]));
    return new THREE.ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms });
  }

  addGraphs(graphs) {
    for (const name of ['source', 'target']) {
      const nodes = new Float32Array(graphs[name].nodes.flat()), tint = graphs[name].tint;
      const dots = new THREE.BufferGeometry().setAttribute('position', new THREE.BufferAttribute(nodes, 3));
      dots.setAttribute('light', new THREE.BufferAttribute(new Uint8Array(nodes.length / 3).fill(255), 1, true));
      const material = this.material(tint, 0, false);
      material.depthTest = false; // what is inside a supervoxel is to be seen
      material.uniforms.size.value = 9;
      material.uniforms.round.value = true;
      this.add(`${name}_nodes`, new THREE.Points(dots, material), false);
      const ends = new Float32Array(graphs[name].edges.flatMap((edge) => edge.flatMap((i) => graphs[name].nodes[i])));
      this.add(`${name}_edges`, this.lines(ends, new THREE.Color(...tint)), false);
    }
    this.add('inliers', this.lines(new Float32Array(0), new THREE.Color(0x12953a)), false);
    this.add('outliers', this.lines(new Float32Array(0), new THREE.Color(0xc8242b)), false);
  }

  lines(ends, color) {
    const geometry = new THREE.BufferGeometry().setAttribute('position', new THREE.BufferAttribute(ends, 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color, depthTest: false }));
  }

  add(name, object, shown = true) {
    object.frustumCulled = false;
    object.renderOrder = object.material.depthTest ? 0 : 1;
    object.matrixAutoUpdate = false;
    this.scene.add(object);
    this.state.layers[name] = shown;
    return (this.parts[name] = object);
  }

  matrixOf(pose) {
    return new THREE.Matrix4().fromArray(this.manifest.poses[pose].matrix.flat()).transpose();
  }

  /** Change what is shown: any of pose, color, layers, cells, slab, slab_at, size, apart. */
  set(changes, glide = true) {
    const layers = { ...this.state.layers, ...(changes.layers || {}) };
    const before = this.state.pose;
    Object.assign(this.state, changes, { layers });
    if (this.state.pose !== before) {
      this.glide = glide ? { from: this.matrix.clone(), to: this.matrixOf(this.state.pose), since: performance.now() } : null;
      if (!glide) this.matrix = this.matrixOf(this.state.pose);
      this.wake(GLIDE + REST);
    }
    this.apply();
    if ('apart' in changes) this.look(this.side);
  }

  apply() {
    const { state, manifest } = this;
    const pose = manifest.poses[state.pose];
    for (const name of ['source', 'target']) {
      const { material, geometry } = this.parts[name], uniforms = material.uniforms;
      const errors = pose.errors && this.arrays[pose.errors[name]];
      if (errors) {
        geometry.attributes.error.array.set(errors);
        geometry.attributes.error.needsUpdate = true;
      }
      uniforms.mode.value = state.color === 'error' && !errors ? MODES.tint : MODES[state.color];
      uniforms.cells.value = state.cells;
      uniforms.half_slab.value = state.slab < 0 ? 0 : manifest.slab;
      if (state.slab >= 0) uniforms.slab_axis.value.set(...manifest.axes[state.slab]);
      uniforms.slab_at.value = state.slab_at;
      uniforms.size.value = state.size * this.renderer.getPixelRatio();
    }
    for (const [name, part] of Object.entries(this.parts)) part.visible = state.layers[name];
    this.place();
    this.wake();
  }

  /** Put what belongs to the source where it is now, and the matches between. */
  place() {
    const placed = new THREE.Matrix4().makeTranslation(this.aside(1)).multiply(this.matrix);
    for (const name of ['source', 'source_nodes', 'source_edges'])
      if (this.parts[name]) this.parts[name].matrix.copy(placed), (this.parts[name].matrixWorldNeedsUpdate = true);
    const graphs = this.manifest.graphs;
    if (!graphs || !(this.state.layers.inliers || this.state.layers.outliers)) return;
    const ends = { inliers: [], outliers: [] };
    graphs.matches.forEach(([i, a]) => {
      const moved = new THREE.Vector3(...graphs.source.nodes[i]).applyMatrix4(this.matrix);
      const fixed = new THREE.Vector3(...graphs.target.nodes[a]);
      const agrees = moved.distanceTo(fixed) < graphs.inlier_distance;
      moved.add(this.aside(1));
      ends[agrees ? 'inliers' : 'outliers'].push(...moved.toArray(), ...fixed.toArray());
    });
    for (const name of ['inliers', 'outliers']) {
      this.parts[name].geometry.dispose();
      this.parts[name].geometry = this.lines(new Float32Array(ends[name]), 0).geometry;
    }
    this.counts = { inliers: ends.inliers.length / 6, outliers: ends.outliers.length / 6 };
  }

  /** The way from where the source belongs to where it is drawn, or a part of it: none, or to the left. */
  aside(part) {
    const { right, width } = this.manifest.views[this.side];
    return new THREE.Vector3(...right).multiplyScalar(this.state.apart ? -1.1 * part * width : 0);
  }

  /** Look from one of the named sides. */
  look(side) {
    this.side = side;
    this.place();
    const { right, down, center, width, distance: near } = this.manifest.views[side];
    const distance = this.state.apart ? Math.max(near, APART * width) : near;
    const r = new THREE.Vector3(...right), d = new THREE.Vector3(...down);
    const away = new THREE.Vector3().crossVectors(r, d); // into the page
    this.controls.target.set(...center).add(this.aside(0.5));
    this.camera.position.copy(this.controls.target).addScaledVector(away, -distance);
    this.camera.up.copy(d).negate();
    this.controls.update();
    this.wake();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.controls) this.controls.handleResize();
    this.wake();
  }

  /** Draw until `more` milliseconds from now, then once more with every point. */
  wake(more = REST) {
    this.until = Math.max(this.until, performance.now() + more);
    this.woken = true; // however long the frame before took
    if (!this.running) {
      this.running = true;
      this.last = null;
      requestAnimationFrame((now) => this.tick(now));
    }
  }

  tick(now) {
    const moving = this.woken || performance.now() < this.until;
    this.woken = false;
    if (this.last !== null) {
      const took = now - this.last, total = this.parts.source.count + this.parts.target.count;
      if (took > FRAME) this.budget = Math.max(10000, Math.min(this.budget, total) * Math.max(0.4, (0.9 * FRAME) / took));
      else if (took < 0.6 * FRAME) this.budget = Math.min(this.budget * 1.2, total);
    }
    this.last = now;
    if (this.glide) {
      const part = Math.min(1, (performance.now() - this.glide.since) / GLIDE), eased = part * part * (3 - 2 * part);
      this.matrix = between(this.glide.from, this.glide.to, eased);
      if (part === 1) this.glide = null;
      this.place();
    }
    this.controls.update();
    this.draw(moving ? this.budget : Infinity);
    if (moving || this.glide) requestAnimationFrame((next) => this.tick(next));
    else this.running = false;
  }

  draw(budget = Infinity) {
    const total = this.parts.source.count + this.parts.target.count, share = Math.min(1, budget / total);
    for (const name of ['source', 'target'])
      this.parts[name].geometry.setDrawRange(0, Math.ceil(share * this.parts[name].count));
    const depth = this.camera.position.distanceTo(this.controls.target);
    for (const part of Object.values(this.parts)) if (part.material.uniforms) part.material.uniforms.depth.value = depth;
    this.renderer.render(this.scene, this.camera);
    this.drawn = Math.ceil(share * total);
  }

  /** Wait for the graphics processor, so that a time measured around it means something. */
  finish() {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}

/** The similarity at `part` of the way from one to another. */
function between(from, to, part) {
  const [a, b] = [from, to].map((matrix) => {
    const piece = { place: new THREE.Vector3(), turn: new THREE.Quaternion(), size: new THREE.Vector3() };
    matrix.decompose(piece.place, piece.turn, piece.size);
    return piece;
  });
  const size = Math.exp((1 - part) * Math.log(a.size.x) + part * Math.log(b.size.x));
  if (part === 1) return to.clone();
  const turn = a.turn.slerp(b.turn, part);
  return new THREE.Matrix4().compose(a.place.lerp(b.place, part), turn, new THREE.Vector3(size, size, size));
}

/** Frames per second while the view turns, and milliseconds from an input to the finished frame. */
async function bench(view, frames = 60) {
  const axis = new THREE.Vector3(0, 1, 0), times = [], latencies = [];
  let last = performance.now();
  for (let k = 0; k < frames; k++) {
    await new Promise(requestAnimationFrame);
    view.until = performance.now() + REST;
    view.camera.position.sub(view.controls.target).applyAxisAngle(axis, 0.03).add(view.controls.target);
    view.wake();
    const now = performance.now();
    if (k >= frames / 2) times.push(now - last); // the first half lets the number of points settle
    last = now;
  }
  for (let k = 0; k < 10; k++) {
    const begin = performance.now();
    view.canvas.dispatchEvent(new WheelEvent('wheel', { deltaY: k % 2 ? 40 : -40, bubbles: true, cancelable: true }));
    await new Promise(requestAnimationFrame);
    view.finish();
    latencies.push(performance.now() - begin);
  }
  const begin = performance.now();
  view.draw();
  view.finish();
  const all = performance.now() - begin, median = (list) => list.sort((a, b) => a - b)[list.length >> 1];
  const total = view.parts.source.count + view.parts.target.count, moving = Math.round(Math.min(view.budget, total));
  return { fps: 1000 / median(times), latency_ms: median(latencies), points_moving: moving, all_points_ms: all };
}

function connect(view) {
  const all = (selector) => [...document.querySelectorAll(selector)];
  all('[data-layer]').forEach((box) => {
    if (!(box.dataset.layer in view.parts)) box.parentElement.remove();
    else box.checked = view.state.layers[box.dataset.layer];
    box.addEventListener('change', () => view.set({ layers: { [box.dataset.layer]: box.checked } }));
  });
  const apart = document.getElementById('apart'), matched = document.getElementById('matched');
  apart.addEventListener('change', () => view.set({ apart: apart.checked }));
  if (!view.parts.inliers) matched.remove();
  matched.addEventListener('click', () => {
    for (const box of [apart, ...all('[data-layer$=_nodes], [data-layer=inliers]')])
      if (!box.checked) box.click();
  });
  const pose = document.getElementById('pose');
  const say = () => (document.getElementById('pose-note').textContent = view.manifest.poses[view.state.pose].note);
  view.manifest.poses.forEach(({ name }, k) => pose.add(new Option(name, k)));
  pose.value = view.state.pose;
  pose.addEventListener('change', () => (view.set({ pose: Number(pose.value) }), say()));
  const flip = document.getElementById('flip');
  let earlier = view.manifest.before;
  flip.addEventListener('click', () => {
    [earlier, pose.value] = [view.state.pose, earlier];
    pose.dispatchEvent(new Event('change'));
  });
  if (!view.manifest.clouds.source.labels) document.querySelector('[value=supervoxels]').parentElement.remove();
  all('[name=color]').forEach((radio) => radio.addEventListener('change', () => {
    view.set({ color: radio.value });
    document.getElementById('ramp').hidden = radio.value !== 'error';
  }));
  all('[data-look]').forEach((button) => button.addEventListener('click', () => view.look(button.dataset.look)));
  const checker = document.getElementById('checker'), slab = document.getElementById('slab'), at = document.getElementById('slab-at');
  checker.addEventListener('change', () => view.set({ cells: checker.checked ? 4 : 0 }));
  const slice = () => view.set({ slab: Number(slab.value), slab_at: Number(at.value) });
  slab.addEventListener('change', () => (slice(), slab.value >= 0 && view.look(['along0', 'along1', 'along2'][slab.value])));
  at.addEventListener('input', slice);
  const size = document.getElementById('size');
  size.value = view.state.size;
  size.addEventListener('input', () => view.set({ size: Number(size.value) }));
  say();
}

(async () => {
  const note = document.getElementById('viewer-note');
  try {
    const manifest = JSON.parse(document.getElementById('manifest').textContent);
    const begin = performance.now();
    const view = new View(document.getElementById('view'), manifest, await unpack(manifest));
    connect(view);
    window.csgm = { view, bench: (frames) => bench(view, frames), ready: performance.now() - begin };
    note.remove();
  } catch (error) {
    note.textContent = `The 3-D view needs WebGL 2, which this browser does not offer (${error.message}). The pictures below show the same.`;
    window.csgm = { failed: String(error) };
  }
})();
