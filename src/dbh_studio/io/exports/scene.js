"use strict";
// A point cloud with stems to click, in WebGL 1 and nothing else. The page works from a file: it fetches nothing.
(function () {
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const stage = document.getElementById("stage"), canvas = document.getElementById("view");
  const overlay = document.getElementById("labels"), pen = overlay.getContext("2d");
  const rows = new Map();
  document.querySelectorAll("tr[data-stem]").forEach(row => rows.set(Number(row.dataset.stem), row));
  const stems = data.stems, byId = new Map(stems.map(stem => [stem.id, stem]));
  let chosen = 0, isDirty = true, showLabels = true, byTree = true, isDead = false;

  function say(text) {
    isDead = true;
    stage.classList.add("off");
    document.getElementById("said").textContent = text;
  }

  function bytes(name) {
    const text = atob(document.getElementById(name).textContent.trim());
    const made = new Uint8Array(text.length);
    for (let k = 0; k < text.length; k++) made[k] = text.charCodeAt(k);
    return made;
  }

  // ---- drawing

  const wanted = new URLSearchParams(location.search).has("nogl") ? null : undefined;
  const options = {antialias: true, preserveDrawingBuffer: false, powerPreference: "high-performance"};
  const gl = wanted === null ? null : canvas.getContext("webgl", options) || canvas.getContext("experimental-webgl", options);
  const n = data.n;
  const place = new Uint16Array(bytes("scene-places").buffer);
  const owner = new Uint16Array(bytes("scene-owners").buffer);
  const natural = bytes("scene-colours");
  const painted = natural.slice();
  for (let k = 0; k < n; k++) {
    const stem = owner[k] ? stems[owner[k] - 1] : null;
    if (stem) painted.set(stem.colour, 3 * k);
  }
  const low = data.low, step = data.step;
  let program, at = {}, colours;

  function shader(kind, text) {
    const made = gl.createShader(kind);
    gl.shaderSource(made, text);
    gl.compileShader(made);
    if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
    return made;
  }

  function buffer(name, values, size, type, normalised) {
    const made = gl.createBuffer(), index = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, size, type, normalised, 0, 0);
    return made;
  }

  function prepare() {
    program = gl.createProgram();
    gl.attachShader(program, shader(gl.VERTEX_SHADER, `
      attribute vec3 place; attribute vec3 colour; attribute float owner;
      uniform mat4 view; uniform vec3 low, step; uniform float size, chosen;
      varying vec3 shown;
      void main() {
        gl_Position = view * vec4(low + step * place, 1.0);
        bool mine = chosen > 0.5 && abs(owner - chosen) < 0.5;
        float faded = chosen > 0.5 && !mine ? 0.45 : 0.0;
        shown = mine ? mix(colour, vec3(1.0, 0.78, 0.0), 0.75) : mix(colour, vec3(0.94, 0.95, 0.94), faded);
        gl_PointSize = clamp((owner > 0.5 ? 1.3 : 1.0) * size / gl_Position.w, 1.5, 14.0);
      }`));
    gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `
      precision mediump float; varying vec3 shown;
      void main() {
        vec2 off = gl_PointCoord - 0.5;
        if (dot(off, off) > 0.25) discard;
        gl_FragColor = vec4(shown, 1.0);
      }`));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    buffer("place", place, 3, gl.UNSIGNED_SHORT, false);
    buffer("owner", owner, 1, gl.UNSIGNED_SHORT, false);
    colours = buffer("colour", painted, 3, gl.UNSIGNED_BYTE, true);
    for (const name of ["view", "low", "step", "size", "chosen"]) at[name] = gl.getUniformLocation(program, name);
    gl.uniform3fv(at.low, low);
    gl.uniform3fv(at.step, step);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.945, 0.953, 0.945, 1);
  }

  function paint() {
    gl.bindBuffer(gl.ARRAY_BUFFER, colours);
    gl.bufferData(gl.ARRAY_BUFFER, byTree ? painted : natural, gl.STATIC_DRAW);
    isDirty = true;
  }

  // ---- the camera turns about a target, z up

  const centre = data.centre, reach = Math.max(data.reach, 1);
  const start = {target: centre.slice(), turn: -0.6, tilt: 0.55, away: 1.9 * reach};
  let camera = {...start, target: start.target.slice()};
  const FIELD = 0.82;

  function eyeOf() {
    const {target, turn, tilt, away} = camera, flat = away * Math.cos(tilt);
    return [target[0] + flat * Math.sin(turn), target[1] - flat * Math.cos(turn), target[2] + away * Math.sin(tilt)];
  }

  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  function unit(a) {
    const length = Math.hypot(...a) || 1;
    return a.map(part => part / length);
  }

  function axes() {
    const eye = eyeOf(), back = unit(minus(eye, camera.target));
    const right = [Math.cos(camera.turn), Math.sin(camera.turn), 0];
    return {eye, back, right, up: cross(back, right)};
  }

  function matrix() {
    const {eye, back, right, up} = axes();
    const near = Math.max(camera.away / 500, 0.02), far = camera.away + 6 * reach + 50;
    const f = 1 / Math.tan(FIELD / 2), aspect = canvas.width / canvas.height;
    const a = (far + near) / (near - far), b = 2 * far * near / (near - far);
    const rows = [[right, f / aspect], [up, f]].map(([axis, k]) => [...axis.map(part => k * part), -k * dot(axis, eye)]);
    const depth = [...back.map(part => a * part), -a * dot(back, eye) + b];
    const w = [...back.map(part => -part), dot(back, eye)];
    const m = new Float32Array(16);
    [rows[0], rows[1], depth, w].forEach((row, i) => row.forEach((value, j) => { m[4 * j + i] = value; }));
    return m;
  }

  function onPage(m, x, y, z) {
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (w <= 0) return null;
    const u = (m[0] * x + m[4] * y + m[8] * z + m[12]) / w, v = (m[1] * x + m[5] * y + m[9] * z + m[13]) / w;
    return [(u + 1) / 2 * overlay.clientWidth, (1 - v) / 2 * overlay.clientHeight, w];
  }

  function fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    for (const each of [canvas, overlay]) {
      const wide = Math.max(1, Math.round(stage.clientWidth * ratio)), high = Math.max(1, Math.round(stage.clientHeight * ratio));
      if (each.width !== wide || each.height !== high) { each.width = wide; each.height = high; }
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    isDirty = true;
  }

  let boxes = [];
  function annotate(m) {
    pen.clearRect(0, 0, overlay.clientWidth, overlay.clientHeight);
    boxes = [];
    const taken = [], shown = [];
    for (const stem of stems) {
      const isChosen = stem.id === chosen;
      if (stem.ring && (isChosen || !chosen)) line(m, stem.ring, isChosen ? "#c2255c" : "rgba(33,37,41,.75)", isChosen ? 3 : 1.3);
      const spot = stem.top && onPage(m, ...stem.top);
      if (spot) shown.push([spot, stem, isChosen]);
    }
    if (!showLabels) return;
    shown.sort((one, other) => other[2] - one[2] || one[0][2] - other[0][2]);
    pen.font = "600 12px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const [[x, y], stem, isChosen] of shown) {
      const text = isChosen ? `${stem.id} · ${stem.dbh}` : String(stem.id), wide = pen.measureText(text).width + 10;
      const box = [x - wide / 2, y - 26, wide, 18];
      const isFree = taken.every(o => box[0] > o[0] + o[2] || o[0] > box[0] + box[2] || box[1] > o[1] + o[3] || o[1] > box[1] + box[3]);
      if (!isFree) continue;
      taken.push(box);
      boxes.push([box, stem.id]);
      pen.strokeStyle = "rgba(60,70,64,.6)";
      pen.lineWidth = 1;
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(x, y - 8);
      pen.stroke();
      pen.fillStyle = isChosen ? "#c2255c" : "rgba(255,255,255,.9)";
      pen.fillRect(...box);
      pen.strokeRect(...box);
      pen.fillStyle = isChosen ? "#fff" : stem.measured ? "#1f2a24" : "#b3261e";
      pen.fillText(text, x, y - 16.5);
    }
  }

  function line(m, ring, colour, width) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.beginPath();
    let isOn = false;
    for (let k = 0; k <= ring.length; k += 3) {
      const j = k % ring.length, spot = onPage(m, ring[j], ring[j + 1], ring[j + 2]);
      if (!spot) { isOn = false; continue; }
      if (isOn) pen.lineTo(spot[0], spot[1]); else pen.moveTo(spot[0], spot[1]);
      isOn = true;
    }
    pen.stroke();
  }

  let n_drawn = 0;
  function draw() {
    requestAnimationFrame(draw);
    if (!isDirty || isDead) return;
    isDirty = false;
    const m = matrix();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.view, false, m);
    gl.uniform1f(at.size, data.grain * canvas.height / Math.tan(FIELD / 2));
    gl.uniform1f(at.chosen, chosen ? 1 + stems.findIndex(stem => stem.id === chosen) : 0);
    gl.drawArrays(gl.POINTS, 0, n);
    annotate(m);
    n_drawn += 1;
  }

  // ---- choosing

  function choose(id, {fly = false} = {}) {
    chosen = byId.has(id) ? id : 0;
    rows.forEach((row, key) => row.classList.toggle("chosen", key === chosen));
    const card = document.getElementById("card");
    document.querySelectorAll("#card article").forEach(each => { each.hidden = Number(each.dataset.stem) !== chosen; });
    card.hidden = !chosen;
    card.scrollTop = 0;
    const row = rows.get(chosen);
    if (row) row.scrollIntoView({block: "nearest"}); // after the card, which takes room from the list
    const stem = byId.get(chosen);
    if (fly && stem && stem.at) camera = {...camera, target: stem.at.slice(), away: Math.min(camera.away, 9), tilt: Math.min(camera.tilt, 0.35)};
    isDirty = true;
  }

  function stemAt(x, y, within) {
    for (const [box, id] of boxes)
      if (x >= box[0] && x <= box[0] + box[2] && y >= box[1] && y <= box[1] + box[3]) return id;
    const m = matrix();
    let best = 0, nearest = Infinity;
    for (let k = 0; k < n; k++) {
      if (!owner[k]) continue;
      const spot = onPage(m, low[0] + step[0] * place[3 * k], low[1] + step[1] * place[3 * k + 1], low[2] + step[2] * place[3 * k + 2]);
      if (spot && spot[2] < nearest && Math.abs(spot[0] - x) < within && Math.abs(spot[1] - y) < within) {
        nearest = spot[2];
        best = stems[owner[k] - 1].id;
      }
    }
    return best;
  }

  // ---- hands: mouse, touch, keys

  function turn(dx, dy) {
    camera.turn -= dx * 0.006;
    camera.tilt = Math.min(1.56, Math.max(-0.3, camera.tilt + dy * 0.006));
    isDirty = true;
  }

  function pan(dx, dy) {
    const {right, up} = axes(), k = 2 * camera.away * Math.tan(FIELD / 2) / overlay.clientHeight;
    camera.target = camera.target.map((value, i) => value - k * dx * right[i] + k * dy * up[i]);
    isDirty = true;
  }

  function zoom(by) {
    camera.away = Math.min(20 * reach, Math.max(0.3, camera.away * by));
    isDirty = true;
  }

  function listen() {
    const fingers = new Map();
    let moved = 0;
    overlay.addEventListener("pointerdown", event => {
      overlay.setPointerCapture(event.pointerId);
      if (!fingers.size) moved = 0;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    overlay.addEventListener("pointermove", event => {
      const was = fingers.get(event.pointerId);
      if (!was) return;
      const now = [event.clientX, event.clientY], dx = now[0] - was[0], dy = now[1] - was[1];
      moved += Math.abs(dx) + Math.abs(dy);
      if (fingers.size === 1) {
        if (event.buttons & 6 || event.shiftKey || event.ctrlKey) pan(dx, dy); else turn(dx, dy);
      } else if (fingers.size === 2) {
        const other = [...fingers].find(([key]) => key !== event.pointerId)[1];
        const before = Math.hypot(was[0] - other[0], was[1] - other[1]), after = Math.hypot(now[0] - other[0], now[1] - other[1]);
        if (before > 5 && after > 5) zoom(before / after);
        pan(dx / 2, dy / 2);
      }
      fingers.set(event.pointerId, now);
    });
    const lift = event => {
      const was = fingers.delete(event.pointerId);
      if (!was || event.type === "pointercancel" || fingers.size || moved > 6 || event.button > 0) return;
      const box = overlay.getBoundingClientRect();
      choose(stemAt(event.clientX - box.left, event.clientY - box.top, event.pointerType === "touch" ? 16 : 7));
    };
    overlay.addEventListener("pointerup", lift);
    overlay.addEventListener("pointercancel", lift);
    overlay.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.0016)); }, {passive: false});
    overlay.addEventListener("contextmenu", event => event.preventDefault());
    const steps = {ArrowLeft: () => turn(-20, 0), ArrowRight: () => turn(20, 0), ArrowUp: () => turn(0, 20), ArrowDown: () => turn(0, -20), "+": () => zoom(0.85), "-": () => zoom(1 / 0.85), Escape: () => choose(0)};
    overlay.addEventListener("keydown", event => {
      if (!steps[event.key]) return;
      event.preventDefault();
      steps[event.key]();
    });
    const press = (name, act) => document.getElementById(name).addEventListener("click", act);
    press("reset", () => { camera = {...start, target: start.target.slice()}; choose(0); });
    press("above", () => { camera.tilt = 1.56; camera.turn = 0; isDirty = true; });
    press("names", event => { showLabels = !showLabels; event.currentTarget.setAttribute("aria-pressed", showLabels); isDirty = true; });
    press("tint", event => { byTree = !byTree; event.currentTarget.setAttribute("aria-pressed", byTree); paint(); });
    new ResizeObserver(fit).observe(stage);
    canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); say("The browser has lost the 3D picture. Load the page again."); });
  }

  rows.forEach((row, id) => row.addEventListener("click", event => {
    event.preventDefault();
    choose(id, {fly: true});
  }));
  window.dbhScene = {
    pixelOf: (x, y, z) => onPage(matrix(), x, y, z), choose, chosen: () => chosen, frames: () => n_drawn, camera: () => camera, isDead: () => isDead,
  };
  if (!gl) {
    say("This browser cannot draw in 3D: WebGL is switched off or not supported. The table of stems works without it.");
    return;
  }
  try {
    prepare();
  } catch (error) {
    say(`This browser cannot draw the cloud (${error.message}). The table of stems works without it.`);
    return;
  }
  listen();
  fit();
  draw();
}());
