// The photo in the page: shows what the server renders, and tells it what the pointer does.
// One message that changes the view is on its way at a time; what happens meanwhile is put together into the next one.
window.dbhPhoto = window.dbhPhoto || (() => {
  const maskTools = window.dbhMaskTools;
  const make = (tag, name, parent, text) => {
    const e = document.createElement(tag);
    if (name) e.className = name;
    if (text) e.textContent = text;
    if (parent) parent.appendChild(e);
    return e;
  };
  const button = (parent, what, text, tip, action) => {
    const e = make('button', '', parent, text);
    e.type = 'button';
    e.title = tip;
    e.dataset.photo = what;
    e.addEventListener('click', action);
    return e;
  };
  const root = document.createElement('div');
  root.id = 'dbh-photo';
  root.className = 'dbh';
  const bar = make('div', 'bar', root);
  button(bar, 'before', '\u25C0', 'Previous photo', () => dbh('photo-step', -1));
  button(bar, 'after', '\u25B6', 'Next photo', () => dbh('photo-step', 1));
  const title = make('b', '', bar), count = make('span', '', bar);
  button(bar, 'close', '\u2715', 'Close the photo', () => dbh('photo-close'));
  const maskRow = make('div', 'maskrow', root);
  const view = make('div', 'view', root), image = make('img', '', view), marks = make('div', 'marks', view);
  const ink = make('canvas', 'ink', view), brush = make('div', 'brush', view), box = make('div', 'box', view);
  const text = make('div', 'text', view), bottom = make('div', 'foot', root), foot = make('span', '', bottom);
  button(bottom, 'fly', 'Go there', 'Look at the cloud from where the photo was taken', () => dbh('photo-fly'));
  const large = button(bottom, 'large', 'Larger', 'Over the cloud', () => enlarge(!isLarge));
  const mask = maskTools(maskRow, view, brush);
  brush.hidden = box.hidden = true;
  image.alt = '';
  image.draggable = false;
  let shown = false, isLarge = false, frame = 0, waiting = 0, asked = null, size = '', held = null, wheel = null, pan = null;

  let again = 0, toSee = false;
  const slot = () => document.querySelector('.dbh-photo-slot');
  function place() {
    if (!shown) { root.remove(); return; }
    const home = isLarge ? document.body : slot();
    if (!home) { clearTimeout(again); again = setTimeout(place, 100); return; }
    if (root.parentNode !== home) home.appendChild(root);
    if (toSee && !isLarge) root.scrollIntoView({block: 'nearest'});
    toSee = false;
    root.dataset.large = isLarge;
    if (isLarge) {
      const box = window.__viserMutable.canvas.getBoundingClientRect();
      Object.assign(root.style, {left: box.x + 8 + 'px', top: box.y + 8 + 'px', width: box.width - 16 + 'px',
        height: box.height - 16 + 'px'});
    } else root.removeAttribute('style');
    large.textContent = isLarge ? 'Smaller' : 'Larger';
    large.title = isLarge ? 'Back into the panel' : 'Over the cloud';
    measure();
  }
  function enlarge(on) { isLarge = on; place(); }
  function measure() {
    const w = Math.round(view.clientWidth), h = Math.round(view.clientHeight);
    if (!shown || w < 50 || h < 50 || size === w + 'x' + h) return;
    size = w + 'x' + h;
    ink.width = w;
    ink.height = h;
    drawInk();
    dbh('photo-size', [w, h]);
  }
  new ResizeObserver(() => measure()).observe(view);
  addEventListener('resize', () => { if (isLarge) place(); });
  // The panel may have been drawn anew without the photo in it.
  setInterval(() => { if (shown && !root.isConnected) place(); }, 400);

  function ask() {
    if (asked !== null && performance.now() - waiting < 1500) return;
    let sent = null;
    if (pan && (pan[0] !== pan[2] || pan[1] !== pan[3])) {
      sent = ['photo-drag', pan];
      pan = held ? [pan[2], pan[3], pan[2], pan[3]] : null;
    } else if (wheel) { sent = ['photo-wheel', wheel]; wheel = null; }
    if (!sent) return;
    asked = frame;
    waiting = performance.now();
    dbh(...sent);
  }
  const at = e => { const b = view.getBoundingClientRect(); return [e.clientX - b.x, e.clientY - b.y]; };
  // What is held: the photo ('pan'), a brush ('paint') or the corner of a box ('box').
  let spaceHeld = false;
  const typing = e => /^(INPUT|TEXTAREA|SELECT)$/.test(e.target.tagName) && !/^(checkbox|range|button)$/.test(e.target.type);
  view.addEventListener('contextmenu', e => { if (mask.tool()) e.preventDefault(); });
  view.addEventListener('pointerdown', e => {
    const tool = mask.tool();
    const isOther = tool && (e.button === 1 || e.button === 2 || spaceHeld);
    if (!(e.button === 0 || isOther) || !frame || held) return;
    e.preventDefault();
    e.stopPropagation();
    if (document.activeElement && document.activeElement !== document.body) document.activeElement.blur();
    view.setPointerCapture(e.pointerId);
    const kind = !tool || isOther ? 'pan' : tool === 'box' ? 'box' : 'paint';
    held = {at: at(e), moved: false, frame, kind, isOther};
    if (kind === 'paint') { stroke = {path: [], number: ++strokes, begun: false}; inkTo(...held.at); }
  });
  view.addEventListener('pointermove', e => {
    const [x, y] = at(e);
    aim(x, y);
    if (!held) return;
    if (held.kind === 'paint') {
      for (const each of e.getCoalescedEvents ? e.getCoalescedEvents() : [e]) inkTo(...at(each));
      inkTo(x, y);
      return;
    }
    if (!held.moved && Math.hypot(x - held.at[0], y - held.at[1]) <= 3) return;
    if (held.kind === 'box') { held.moved = true; showBox(held.at, [x, y]); return; }
    if (!held.moved) { held.moved = true; pan = [held.at[0], held.at[1], x, y]; view.dataset.held = true; }
    else if (pan) { pan[2] = x; pan[3] = y; }
    ask();
  });
  view.addEventListener('pointerleave', () => { brush.hidden = true; });
  const release = e => {
    if (!held) return;
    const was = held;
    held = null;
    delete view.dataset.held;
    box.hidden = true;
    if (was.kind === 'paint') { sendInk(true); return; }
    if (e.type !== 'pointerup') { if (was.moved) ask(); return; }
    if (was.kind === 'box') dbh('photo-box', [was.frame, ...was.at, ...(was.moved ? at(e) : was.at)]);
    else if (was.moved) ask();
    else if (!was.isOther) dbh('photo-click', [was.frame, ...was.at]);
  };
  view.addEventListener('pointerup', release);
  view.addEventListener('pointercancel', release);

  // ---- the brush: what was painted is drawn here at once, and goes when a picture comes that has it
  let stroke = null, strokes = 0, batches = 0, inkTimer = 0, inked = [];
  function aim(x, y) {
    const radius = mask.radius();
    brush.hidden = !radius;
    if (!radius) return;
    Object.assign(brush.style, {left: x - radius + 'px', top: y - radius + 'px', width: 2 * radius + 'px',
      height: 2 * radius + 'px'});
  }
  function showBox([x0, y0], [x1, y1]) {
    box.hidden = false;
    Object.assign(box.style, {left: Math.min(x0, x1) + 'px', top: Math.min(y0, y1) + 'px',
      width: Math.abs(x1 - x0) + 'px', height: Math.abs(y1 - y0) + 'px'});
  }
  function inkTo(x, y) {
    const path = stroke.path, n = path.length;
    if (n && Math.hypot(x - path[n - 2], y - path[n - 1]) < Math.max(1, mask.radius() / 5)) return;
    path.push(x, y);
    drawInk();
    if (path.length > 80) sendInk(false);
    else if (!inkTimer) inkTimer = setTimeout(() => sendInk(false), 60);
  }
  function sendInk(isEnd) {
    clearTimeout(inkTimer);
    inkTimer = 0;
    if (!stroke) return;
    const path = stroke.path, fresh = stroke.begun ? path.length > 2 : path.length > 0;
    if (!fresh && !isEnd) return;
    const batch = {number: ++batches, path: path.slice(), tool: mask.tool(), radius: mask.radius()};
    inked.push(batch);
    dbh('photo-paint', [frame, batch.number, stroke.begun ? (isEnd ? 2 : 1) : (isEnd ? 3 : 0), batch.radius,
      batch.path]);
    stroke.begun = true;
    stroke.path = path.slice(-2);
    if (isEnd) stroke = null;
  }
  function drawInk() {
    const c = ink.getContext('2d');
    c.clearRect(0, 0, ink.width, ink.height);
    const all = stroke && stroke.path.length
      ? [...inked, {path: stroke.path, tool: mask.tool(), radius: mask.radius()}] : inked;
    for (const {path, tool, radius} of all) {
      c.strokeStyle = c.fillStyle = tool === 'erase' ? '#111' : '#ffe066';
      c.lineWidth = 2 * radius;
      c.lineCap = c.lineJoin = 'round';
      c.beginPath();
      c.moveTo(path[0], path[1]);
      for (let i = 0; i < path.length; i += 2) c.lineTo(path[i] + (path.length === 2 ? 0.01 : 0), path[i + 1]);
      c.stroke();
    }
  }
  function forgetInk(upTo) {
    inked = inked.filter(batch => batch.number > upTo);
    drawInk();
  }
  // After a click into the cloud its keys are meant.
  let inScene = false;
  addEventListener('pointerdown', e => { inScene = e.target.tagName === 'CANVAS' && !root.contains(e.target); }, true);
  // Before the page moves the camera with the same keys.
  addEventListener('keydown', e => {
    if (!shown || (inScene && !isLarge) || typing(e) || e.ctrlKey || e.metaKey || e.altKey) return;
    if (mask.tool() && e.code === 'Space') { spaceHeld = true; view.dataset.pan = true; }
    else if (!mask.key(e.key)) return;
    e.preventDefault();
    e.stopImmediatePropagation();
    if (brush.style.left && !brush.hidden) {
      const b = brush.getBoundingClientRect(), v = view.getBoundingClientRect();
      aim(b.x + b.width / 2 - v.x, b.y + b.height / 2 - v.y);
    }
  }, true);
  addEventListener('keyup', e => {
    if (e.code === 'Space') { spaceHeld = false; delete view.dataset.pan; }
  }, true);
  view.addEventListener('wheel', e => {
    e.preventDefault();
    e.stopPropagation();
    if (!frame || (held && held.kind !== 'pan')) return;
    const steps = -e.deltaY * (e.deltaMode === 1 ? 16 : e.deltaMode === 2 ? 100 : 1) / 100;
    wheel = [...at(e), Math.max(-20, Math.min(20, (wheel ? wheel[2] : 0) + steps))];
    ask();
  }, {passive: false});

  function draw(list) {
    marks.textContent = '';
    for (const [x, y, label, kind] of list) {
      const e = make('i', '', marks);
      e.dataset.kind = kind;
      e.style.left = x + 'px';
      e.style.top = y + 'px';
      if (label) make('span', '', e, label);
    }
  }
  return {
    wait(on) { view.dataset.wait = on; },
    title(position) { count.textContent = position; },
    masks(state) {
      mask.show(state);
      view.dataset.tool = mask.tool() || '';
      if (!mask.tool()) { brush.hidden = box.hidden = true; spaceHeld = false; }
      measure();
    },
    open(name, position, hint, picks) {
      toSee = !shown;
      shown = true;
      title.textContent = title.title = name;
      count.textContent = position;
      foot.textContent = hint;
      view.dataset.picks = picks;
      place();
    },
    say(message) {
      text.textContent = message;
      image.hidden = marks.hidden = true;
      text.hidden = false;
      frame = 0;
      asked = null;
      held = pan = wheel = stroke = null;
      forgetInk(Infinity);
    },
    frame(number, source, list, hint, picks, painted) {
      image.src = source;
      image.hidden = marks.hidden = false;
      text.hidden = true;
      foot.textContent = hint;
      view.dataset.picks = picks;
      frame = number;
      view.dataset.frame = number;
      asked = null;
      draw(list);
      // Once the picture is there: else the stroke would blink.
      if (inked.length) image.decode().catch(() => 0).then(() => forgetInk(painted));
      ask();
    },
    close() { shown = isLarge = false; size = ''; frame = 0; place(); },
  };
})();
