// Correcting trunks in the page: the bar over the picture, and what is drawn over the picture with its tools.
// It shows what the server says, and sends each drawing with the camera it was drawn in.
window.dbhEdit = window.dbhEdit || (() => {
  const make = (tag, name, parent, text) => {
    const e = document.createElement(tag);
    if (name) e.className = name;
    if (text) e.textContent = text;
    if (parent) parent.appendChild(e);
    return e;
  };
  const act = (what, value) => dbh('edit', [what, value === undefined ? null : value]);
  const button = (parent, what, title, tip, action) => {
    const e = make('button', '', parent, title);
    e.type = 'button';
    e.title = tip;
    e.dataset.edit = what;
    e.addEventListener('click', event => {
      e.blur();  // the key Enter or Space must not press it again afterwards
      if (!isSecondOfDouble(event, e)) (action || (() => act(what)))();
    });
    return e;
  };
  // After a press other buttons may lie where it was: a double click on Take off must not press what comes to lie there.
  let pressed = {e: null, at: -1e9, x: 0, y: 0};
  const isSecondOfDouble = (event, e) => {
    const near = Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < 8 && event.detail > 0;
    const isOther = near && e !== pressed.e && performance.now() - pressed.at < 400;
    pressed = {e: isOther ? pressed.e : e, at: performance.now(), x: event.clientX, y: event.clientY};
    return isOther;
  };
  const slider = (parent, what, name, low, high, step) => {
    const label = make('label', '', parent, name + ' '), e = make('input', '', label), said = make('output', '', label);
    Object.assign(e, {type: 'range', min: low, max: high, step: step});
    e.dataset.set = what;
    e.addEventListener('input', () => dbh('edit-set', [what, Number(e.value)]));
    e.addEventListener('change', () => e.blur());
    return {label, e, said};
  };
  const check = (parent, what, name, tip) => {
    const label = make('label', '', parent), e = make('input', '', label);
    e.type = 'checkbox';
    e.dataset.edit = what;
    label.title = tip;
    label.append(' ' + name);
    e.addEventListener('change', () => { e.blur(); act(what); });
    return e;
  };
  const bar = make('div', 'dbh'), tools = make('div', 'line tools', bar), view = make('div', 'line view', bar);
  bar.id = 'dbh-edit';
  bar.hidden = true;
  const only = check(view, 'only', 'Only this tree', 'Select points of the chosen tree only (I)');
  const others = check(view, 'others', 'Hide the others', 'Show this tree and what is within a metre of it (O)');
  const slice = check(view, 'slice', 'Slice', 'Show a slice at breast height only (U)');
  const thick = slider(view, 'slice', 'Thickness', 5, 200, 5), brush = slider(view, 'brush', 'Brush', 1, 100, 1);
  const above = button(view, 'above', 'From above', 'Look down on the tree', () => act('above'));
  const turn = make('div', 'line view', bar);
  const upright = button(turn, 'upright', 'Upright', 'An upright cut', () => dbh('edit-set', ['level', 0]));
  const level = button(turn, 'level', 'Level', 'A level cut', () => dbh('edit-set', ['level', 1]));
  const degrees = slider(turn, 'degrees', 'Direction', 0, 179, 1), shift = slider(turn, 'shift', 'Shift', -1, 1, 0.005);
  const height = slider(turn, 'height', 'Height', 0, 10, 0.01);
  const doing = make('div', 'line doing', bar), chosen = make('b', 'chosen', doing), buttons = make('span', '', doing);
  const said = make('div', 'line said', bar), effect = make('b', 'effect', said), hint = make('span', 'hint', said);
  const keys = make('div', 'keys', bar);
  keys.hidden = true;
  const ink = make('canvas'), ring = make('div');
  ink.id = 'dbh-edit-ink';
  ring.id = 'dbh-edit-ring';
  ring.hidden = true;
  let state = null, drawnTools = '', drawnButtons = '', drawnKeys = '', toolButtons = {};

  const canvas = () => window.__viserMutable && window.__viserMutable.canvas;
  function place() {
    const c = canvas();
    if (!c || bar.hidden) return;
    const box = c.getBoundingClientRect();
    Object.assign(bar.style, {left: box.x + 12 + 'px', top: box.y + 12 + 'px', width: Math.max(Math.min(box.width - 24, 850), 200) + 'px'});
  }
  addEventListener('resize', place);
  setInterval(place, 500);

  function show(next) {
    state = next && next.tool ? next : null;
    bar.hidden = !state;
    if (!bar.isConnected) document.body.append(ink, ring, bar);
    if (!state) { stop(); ring.hidden = true; turns(false); return; }
    const wanted = JSON.stringify(state.tools);
    if (wanted !== drawnTools) {
      drawnTools = wanted;
      tools.replaceChildren();
      toolButtons = {};
      for (const [tool, title, key, tip] of state.tools) {
        toolButtons[tool] = button(tools, 'tool-' + tool, title, tip + ' (' + key + ')', () => act('tool', tool));
      }
      button(tools, 'keys', 'Keys', 'All keys', () => { keys.hidden = !keys.hidden; }).classList.add('plain');
      button(tools, 'close', 'Done', 'Close the tools; everything is saved as you go').classList.add('plain', 'end');
    }
    for (const [tool, e] of Object.entries(toolButtons)) e.setAttribute('aria-pressed', tool === state.tool);
    only.checked = state.only;
    others.checked = state.others;
    slice.checked = state.slice;
    only.disabled = others.disabled = slice.disabled = !state.hasTree;
    above.hidden = !state.slice && !state.others;
    thick.label.hidden = !state.slice;
    fill(thick, state.sliceCm, state.sliceCm + ' cm');
    brush.label.hidden = state.tool !== 'brush';
    fill(brush, state.brushCm, state.brushCm + ' cm');
    turn.hidden = !state.plane;
    if (state.plane) {
      const p = state.plane;
      upright.setAttribute('aria-pressed', !p.level);
      level.setAttribute('aria-pressed', p.level);
      degrees.label.hidden = shift.label.hidden = p.level;
      height.label.hidden = !p.level;
      Object.assign(shift.e, {min: -p.shift_limit, max: p.shift_limit, step: 'any'});
      Object.assign(height.e, {min: p.low, max: p.high, step: 'any'});
      fill(degrees, p.degrees, p.degrees + '\u00B0');
      fill(shift, p.shift, Math.round(100 * p.shift) + ' cm');
      fill(height, p.height, p.height.toFixed(2) + ' m');
    }
    chosen.textContent = state.chosen;
    const offered = JSON.stringify(state.buttons);
    if (offered !== drawnButtons) {
      drawnButtons = offered;
      buttons.replaceChildren();
      for (const [what, title, tip] of state.buttons) button(buttons, what, title, tip);
    }
    say(state.effect);
    hint.textContent = state.note || state.hint;
    hint.dataset.level = state.note ? 'note' : '';
    const listed = JSON.stringify(state.keys);
    if (listed !== drawnKeys) {
      drawnKeys = listed;
      keys.replaceChildren();
      for (const [key, what] of state.keys) { make('kbd', '', keys, key); make('span', '', keys, what); }
    }
    turns(state.draws);
    ring.hidden = ring.hidden || state.tool !== 'brush';
    if (!state.draws) stop();
    place();
  }
  function fill(control, value, words) {
    if (document.activeElement !== control.e) control.e.value = value;
    control.said.textContent = words;
  }
  function say(words) {
    effect.textContent = words;
    effect.hidden = !words;
  }
  // While a tool draws with the left button, the right one turns the view and the middle one moves it.
  let isTurned = false;
  function turns(on) {
    const control = window.__viserMutable && window.__viserMutable.cameraControl;
    if (!control || on === isTurned) return;
    isTurned = on;
    control.mouseButtons.right = on ? 1 : 2;
    control.mouseButtons.middle = on ? 2 : 16;
    canvas().style.cursor = on ? 'crosshair' : '';
  }

  // ---- drawing

  function camera() {
    const m = window.__viserMutable, c = m.camera, root = m.nodeRefFromName[''], V = c.position.constructor;
    c.updateMatrixWorld();
    const e = c.matrixWorld.elements, at = new V(e[12], e[13], e[14]), origin = root.worldToLocal(at.clone());
    const along = (x, y, z) => root.worldToLocal(new V(x, y, z).add(at)).sub(origin).normalize();
    const box = m.canvas.getBoundingClientRect();
    const rows = [origin, along(e[0], e[1], e[2]), along(-e[4], -e[5], -e[6]), along(-e[8], -e[9], -e[10])];
    return [...rows.flatMap(v => [v.x, v.y, v.z]), c.fov * Math.PI / 180, box.width / box.height, box.height];
  }
  // What is being drawn: its way in pixels of the picture, and how much of it a brush has sent.
  let stroke = null, isWaiting = false, waitedFrom = 0;
  const at = e => { const b = canvas().getBoundingClientRect(); return [e.clientX - b.x, e.clientY - b.y]; };
  const isOnPicture = e => {
    const c = canvas();
    return c && e.target instanceof Element && (e.target === c || (c.parentElement && c.parentElement.contains(e.target)));
  };
  function stop() {
    stroke = null;
    const pen = ink.getContext('2d');
    pen.clearRect(0, 0, ink.width, ink.height);
  }
  function paint() {
    const c = canvas(), box = c.getBoundingClientRect(), pen = ink.getContext('2d');
    if (ink.width !== Math.round(box.width) || ink.height !== Math.round(box.height)) {
      ink.width = Math.round(box.width);
      ink.height = Math.round(box.height);
    }
    Object.assign(ink.style, {left: box.x + 'px', top: box.y + 'px'});
    pen.clearRect(0, 0, ink.width, ink.height);
    if (!stroke) return;
    const path = stroke.path, first = path[0], last = path[path.length - 1];
    const lines = [];
    if (state.tool === 'rectangle') {
      lines.push([first, [last[0], first[1]], last, [first[0], last[1]], first]);
    } else if (state.tool === 'line') lines.push([first, last]);
    else if (state.tool === 'lasso') lines.push([...path, first]);
    else return;
    for (const [colour, width] of [['rgba(0,0,0,.75)', 4], [stroke.mode === 'take' ? '#ffa8a8' : '#ffe066', 2]]) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      for (const line of lines) {
        pen.beginPath();
        line.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
        pen.stroke();
      }
    }
    if (state.tool === 'lasso' || state.tool === 'rectangle') {
      pen.fillStyle = 'rgba(255,224,102,.18)';
      pen.beginPath();
      lines[0].forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.fill('evenodd');
    }
  }
  function send(isEnd) {
    const box = canvas().getBoundingClientRect();
    let path = stroke.path.slice(stroke.sent);
    if (state.tool === 'rectangle' || state.tool === 'line') path = [stroke.path[0], stroke.path[stroke.path.length - 1]];
    const step = Math.ceil(path.length / 600);
    path = path.filter((_, i) => i % step === 0 || i === path.length - 1);
    stroke.sent = stroke.path.length - (state.tool === 'brush' ? 1 : 0);
    isWaiting = true;
    waitedFrom = performance.now();
    const places = path.flatMap(([x, y]) => [x / box.width, y / box.height].map(v => Math.round(v * 1e5) / 1e5));
    dbh('edit-draw', [state.tool, stroke.mode, isEnd, camera(), places]);
  }
  function ringAt(x, y) {
    if (!state || state.tool !== 'brush' || !state.at) { ring.hidden = true; return; }
    const c = canvas(), box = c.getBoundingClientRect(), view = camera();
    const far = Math.hypot(view[0] - state.at[0], view[1] - state.at[1], view[2] - state.at[2]);
    const size = Math.max(2, state.brushCm / 100 / Math.max(far, 0.01) / Math.tan(view[12] / 2) * box.height);
    Object.assign(ring.style, {left: box.x + x - size / 2 + 'px', top: box.y + y - size / 2 + 'px', width: size + 'px',
      height: size + 'px'});
    ring.hidden = false;
  }
  addEventListener('pointerdown', e => {
    if (!state || !state.draws || e.button !== 0 || stroke || !isOnPicture(e)) return;
    e.preventDefault();
    e.stopImmediatePropagation();
    if (document.activeElement && document.activeElement !== document.body) document.activeElement.blur();
    stroke = {path: [at(e)], mode: e.altKey ? 'take' : e.shiftKey ? 'add' : 'new', sent: 0, pointer: e.pointerId};
    paint();
    if (state.tool === 'brush') send(false);
  }, true);
  addEventListener('pointermove', e => {
    if (state && state.draws && isOnPicture(e)) ringAt(...at(e));
    if (!stroke || e.pointerId !== stroke.pointer) return;
    e.preventDefault();
    e.stopImmediatePropagation();
    const here = at(e), last = stroke.path[stroke.path.length - 1];
    if (Math.hypot(here[0] - last[0], here[1] - last[1]) < 2) return;
    stroke.path.push(here);
    paint();
    if (state.tool === 'brush' && (!isWaiting || performance.now() - waitedFrom > 1500)) send(false);
  }, true);
  addEventListener('pointerup', e => {
    if (!stroke || e.pointerId !== stroke.pointer) return;
    e.preventDefault();
    e.stopImmediatePropagation();
    const here = at(e), last = stroke.path[stroke.path.length - 1];
    if (here[0] !== last[0] || here[1] !== last[1]) stroke.path.push(here);
    send(true);
    stop();
  }, true);
  addEventListener('pointercancel', () => { if (stroke) stop(); }, true);
  // After a drawing the page would still see a click, and choose what lies under it.
  addEventListener('click', e => { if (state && state.draws && isOnPicture(e)) e.stopImmediatePropagation(); }, true);

  // ---- keys that viser's commands do not know, and Esc while drawing

  const isTyping = e => e.target instanceof Element && (e.target.isContentEditable
    || (/^(INPUT|TEXTAREA|SELECT)$/.test(e.target.tagName) && !/^(checkbox|range|button|radio)$/.test(e.target.type)));
  addEventListener('keydown', e => {
    if (!state || isTyping(e)) return;
    if (e.key === 'Escape' && stroke) { e.stopImmediatePropagation(); stop(); return; }
    if (e.key === 'Escape' && !keys.hidden) { e.stopImmediatePropagation(); keys.hidden = true; return; }
    // Held down it repeats itself: the points would go, and then the trunk that they were taken off.
    if (e.key === 'Delete' && e.repeat) { e.stopImmediatePropagation(); e.preventDefault(); return; }
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const what = {'[': 'narrower', ']': 'wider', '+': 'grow', '=': 'grow', '-': 'shrink', '\u2212': 'shrink'}[e.key];
    if (!what || ((what === 'narrower' || what === 'wider') && state.tool !== 'brush')) return;
    e.preventDefault();
    act(what);
  }, true);
  return {
    show,
    style(text) {
      if (document.getElementById('dbh-edit-style')) return;
      const e = make('style', '', document.head, text);
      e.id = 'dbh-edit-style';
    },
    type_number() {
      const field = document.getElementById('dbh-call-number');
      if (field) { field.scrollIntoView({block: 'nearest'}); field.focus(); field.select(); }
    },
    // Two edits may have the same effect: it must be seen that something was done.
    effect(words) {
      if (state) state.effect = words;
      say(words);
      effect.animate([{background: '#b2f2bb'}, {background: 'transparent'}], 900);
    },
    // The server has dealt with a drawing; a brush sends what was painted meanwhile.
    taken() {
      isWaiting = false;
      if (stroke && state && state.tool === 'brush' && stroke.path.length > stroke.sent + 1) send(false);
    },
  };
})();
