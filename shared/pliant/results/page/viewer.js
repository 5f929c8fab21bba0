"use strict";
// A cloud of points, a mesh and a path that can be turned.  The data is one block of bytes:
// positions are 16-bit shares of a box, their number is in the header.
const header = JSON.parse(document.getElementById("scene").textContent);
const text = atob(document.getElementById("bytes").textContent.trim());
const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer;
const canvas = document.getElementById("view");
const gl = canvas.getContext("webgl2", { antialias: true });

const VERTEX = `#version 300 es
in vec3 place; in vec3 colour; in vec2 uv; uniform mat4 seen; uniform vec3 low; uniform vec3 size; uniform float dot_px;
out vec3 tint; out vec3 world; out vec2 at;
void main() { world = low + place * size; tint = colour; at = uv; gl_Position = seen * vec4(world, 1.0);
  gl_PointSize = clamp(dot_px / gl_Position.w, 1.5, 12.0); }`;
const FRAGMENT = `#version 300 es
precision highp float; in vec3 tint; in vec3 world; in vec2 at; uniform vec3 eye; uniform float lit; uniform float textured;
uniform sampler2D photographs; out vec4 shown;
void main() { float light = 1.0;
  if (lit > 0.5) {
    vec3 normal = normalize(cross(dFdx(world), dFdy(world)));
    light = 0.45 + 0.55 * abs(dot(normal, normalize(eye - world)));
  }
  shown = vec4(textured > 0.5 ? texture(photographs, at).rgb : tint * light, 1.0); }`;

function compiled(kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  return shader;
}

function begin() {
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  const places = { seen: at("seen"), low: at("low"), size: at("size"), eye: at("eye"), lit: at("lit"), textured: at("textured"), dot: at("dot_px") };

  function parts(layer) {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const fill = (name, offset, count, kind, size = 3) => {
      const place = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, new DataView(bytes, offset, count), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, kind, true, 0, 0);
    };
    fill("place", layer.places, 6 * layer.count, gl.UNSIGNED_SHORT);
    if (layer.colours !== undefined) fill("colour", layer.colours, 3 * layer.count, gl.UNSIGNED_BYTE);
    if (layer.uvs !== undefined) fill("uv", layer.uvs, 4 * layer.count, gl.UNSIGNED_SHORT, 2);
    if (layer.triangles) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new DataView(bytes, layer.indices, 12 * layer.triangles), gl.STATIC_DRAW);
    }
    return array;
  }

  const layers = header.layers.map((layer) => ({ ...layer, array: parts(layer), shown: true }));
  if (layers.some((layer) => layer.name === "mesh")) layers.forEach((layer) => (layer.shown = layer.name !== "points"));
  const box = document.getElementById("layers");
  for (const layer of layers) {
    const label = document.createElement("label");
    const tick = document.createElement("input");
    tick.type = "checkbox";
    tick.checked = layer.shown;
    tick.onchange = () => { layer.shown = tick.checked; draw(); };
    label.append(tick, " " + layer.name);
    box.append(label);
  }

  // A surface that moves has a mesh for each key frame; the last one is shown at first.
  const moving = layers.find((layer) => layer.keys);
  let key = moving ? moving.keys.length - 1 : 0;
  if (moving) addSlider();

  function addSlider() {
    const [slider, play, name] = ["input", "button", "output"].map((kind) => document.createElement(kind));
    const { keys } = moving, last = keys.length - 1;
    Object.assign(slider, { type: "range", max: last, value: last, ariaLabel: "key frame" });
    const show = (number) => {
      key = number;
      slider.value = key;
      name.textContent = `${keys[key].name}, ${keys[key].time.toFixed(2)} s`;
    };
    let started = null;
    const step = (now) => {
      if (started === null) return;
      const time = keys[0].time + 0.001 * (now - started);
      let at = keys.findIndex((each) => each.time > time);
      if (at < 0) [at, started] = [keys.length, null];
      show(Math.max(at - 1, 0));
      if (started === null) play.textContent = "Play";
      else requestAnimationFrame(step);
      draw();
    };
    play.textContent = "Play";
    play.onclick = () => {
      const from = key < last ? keys[key].time : keys[0].time;
      started = started === null ? performance.now() - 1000 * (from - keys[0].time) : null;
      play.textContent = started === null ? "Play" : "Stop";
      if (started !== null) requestAnimationFrame(step);
    };
    slider.oninput = () => { started = null; play.textContent = "Play"; show(Number(slider.value)); draw(); };
    show(last);
    document.getElementById("time").append(play, slider, name);
  }

  // The eye goes round a point: turn about the world's up, height over it, and distance.
  const view = { turn: 0, height: header.height, distance: header.distance, target: [...header.target] };
  const [right0, up, forward0] = header.axes;
  const sum = (...terms) => [0, 1, 2].map((k) => terms.reduce((all, [share, vector]) => all + share * vector[k], 0));
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  function axes() {
    const [c, s] = [Math.cos(view.turn), Math.sin(view.turn)];
    const right = sum([c, right0], [s, forward0]);
    const level = sum([-s, right0], [c, forward0]);
    const [ch, sh] = [Math.cos(view.height), Math.sin(view.height)];
    return { right, forward: sum([ch, level], [-sh, up]), above: sum([sh, level], [ch, up]) };
  }

  // Two points that were double-clicked, and how far apart they are.
  const picked = [], marks = { array: gl.createVertexArray(), buffer: gl.createBuffer() };
  let rows = [];
  const seenAt = (place) => {
    const [x, y, , w] = rows.map((row) => dot(row, place) + row[3]);
    return { x: (0.5 + 0.5 * x / w) * canvas.clientWidth, y: (0.5 - 0.5 * y / w) * canvas.clientHeight, w };
  };

  canvas.ondblclick = (event) => {
    const place = nearest(event.offsetX, event.offsetY);
    if (!place) return;
    if (picked.length === 2) picked.length = 0;
    picked.push(place);
    const text = picked.map((each) => each.map((value) => value.toPrecision(5)).join(","));
    const apart = picked.length === 2 ? Math.hypot(...sum([1, picked[0]], [-1, picked[1]])).toPrecision(4) : "";
    document.getElementById("picked").textContent = apart
      ? `${apart} apart; for metres run: pliant scale RESULT --points ${text.join(" ")} METRES` : `${text}, double-click another point`;
    gl.bindVertexArray(marks.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, marks.buffer);
    const shares = picked.flatMap((each) => each.map((value, k) => (value - header.low[k]) / header.size[k]));
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(shares), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(gl.getAttribLocation(program, "place"));
    gl.vertexAttribPointer(gl.getAttribLocation(program, "place"), 3, gl.FLOAT, false, 0, 0);
    draw();
  };

  // Of what is shown within a few pixels of the pointer the nearest to the eye; null: nothing is.
  function nearest(px, py) {
    let found = null, depth = Infinity;
    for (const layer of layers.filter((each) => each.shown && !each.line)) {
      const [from, to] = layer.keys ? layer.keys[key].vertices : [0, layer.count];
      const shares = new Uint16Array(bytes, layer.places + 6 * from, 3 * (to - from));
      for (let n = 0; n < shares.length; n += 3) {
        const place = [0, 1, 2].map((k) => header.low[k] + shares[n + k] / 65535 * header.size[k]);
        const { x, y, w } = seenAt(place);
        if (w > 0 && w < depth && Math.hypot(x - px, y - py) < 8) [found, depth] = [place, w];
      }
    }
    return found;
  }

  function draw() {
    const { right, forward, above } = axes();
    const eye = sum([1, view.target], [-view.distance, forward]);
    canvas.width = canvas.clientWidth * devicePixelRatio;
    canvas.height = canvas.clientHeight * devicePixelRatio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(16 / 255, 19 / 255, 24 / 255, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);  // one looks into a room through its walls
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    // What fits into 4 to 3 fits into a telephone held upright, too.
    const f = 2.4 / Math.max(1, 4 / 3 * canvas.height / canvas.width), [near, far] = [0.01 * view.distance, 50 * header.distance];
    rows = [
      [f * canvas.height / canvas.width, right], [f, above], [(far + near) / (far - near), forward], [1, forward],
    ].map(([scale, axis]) => [...axis.map((value) => scale * value), -scale * dot(axis, eye)]);
    rows[2][3] -= 2 * far * near / (far - near);
    gl.uniformMatrix4fv(places.seen, false, [0, 1, 2, 3].flatMap((k) => rows.map((row) => row[k])));
    gl.uniform3fv(places.low, header.low);
    gl.uniform3fv(places.size, header.size);
    gl.uniform3fv(places.eye, eye);
    gl.uniform1f(places.dot, 0.004 * canvas.height * header.distance);
    for (const layer of layers.filter((each) => each.shown)) {
      gl.bindVertexArray(layer.array);
      gl.uniform1f(places.lit, layer.triangles ? 1 : 0);
      gl.uniform1f(places.textured, layer.uvs === undefined ? 0 : 1);  // photographs have their light
      const [from, to] = layer.keys ? layer.keys[key].triangles : [0, layer.triangles];
      layer.keys ? gl.disable(gl.CULL_FACE) : gl.enable(gl.CULL_FACE);  // a cloth has no inside
      if (layer.triangles) gl.drawElements(gl.TRIANGLES, 3 * (to - from), gl.UNSIGNED_INT, 12 * from);
      else gl.drawArrays(layer.pairs ? gl.LINES : layer.line ? gl.LINE_STRIP : gl.POINTS, 0, layer.count);
    }
    gl.bindVertexArray(marks.array);
    gl.disable(gl.DEPTH_TEST);
    gl.uniform1f(places.lit, 0);
    gl.uniform1f(places.textured, 0);
    gl.uniform1f(places.dot, 1e6);
    gl.vertexAttrib3f(gl.getAttribLocation(program, "colour"), 1, 0.2, 0.5);
    gl.drawArrays(gl.POINTS, 0, picked.length);
  }

  const fingers = new Map();
  canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); };
  canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const other = [...fingers.values()].find((each) => each.pointerId !== event.pointerId);
    if (other) {
      const apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
      view.distance *= apart(before) / Math.max(apart(event), 1);
    } else if (event.buttons & 2 || event.shiftKey) {
      const { right, above } = axes(), step = view.distance / (1.2 * canvas.clientHeight);
      view.target = sum([1, view.target], [-step * dx, right], [step * dy, above]);
    } else {
      view.turn -= 0.006 * dx;
      view.height = Math.min(1.55, Math.max(-1.55, view.height + 0.006 * dy));
    }
    fingers.set(event.pointerId, event);
    draw();
  };
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.distance *= Math.exp(0.001 * event.deltaY);
    draw();
  }, { passive: false });
  new ResizeObserver(draw).observe(canvas);
  draw();
  if (header.texture) {
    const image = new Image();
    image.onload = () => {
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
      draw();
    };
    image.src = header.texture;
  }
  canvas.dataset.drawn = "yes";
}

if (gl) begin();
else document.getElementById("layers").textContent = "No 3D view: this browser has no WebGL 2: open points.ply or mesh.ply.";
