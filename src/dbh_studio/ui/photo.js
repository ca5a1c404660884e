// The photo in the page: shows what the server renders, and tells it what the pointer does.
// One message that changes the view is on its way at a time; what happens meanwhile is put together into the next one.
window.dbhPhoto = window.dbhPhoto || (() => {
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
  const view = make('div', 'view', root), image = make('img', '', view), marks = make('div', 'marks', view);
  const text = make('div', 'text', view), bottom = make('div', 'foot', root), foot = make('span', '', bottom);
  button(bottom, 'fly', 'Go there', 'Look at the cloud from where the photo was taken', () => dbh('photo-fly'));
  const large = button(bottom, 'large', 'Larger', 'Over the cloud', () => enlarge(!isLarge));
  image.alt = '';
  image.draggable = false;
  let shown = false, isLarge = false, frame = 0, waiting = 0, asked = null, size = '', held = null, wheel = null, pan = null;

  let again = 0;
  const slot = () => document.querySelector('.dbh-photo-slot');
  function place() {
    if (!shown) { root.remove(); return; }
    const home = isLarge ? document.body : slot();
    if (!home) { clearTimeout(again); again = setTimeout(place, 100); return; }
    if (root.parentNode !== home) home.appendChild(root);
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
  view.addEventListener('pointerdown', e => {
    if (e.button !== 0 || !frame) return;
    e.preventDefault();
    e.stopPropagation();
    view.setPointerCapture(e.pointerId);
    held = {at: at(e), moved: false, frame};
  });
  view.addEventListener('pointermove', e => {
    if (!held) return;
    const [x, y] = at(e);
    if (!held.moved && Math.hypot(x - held.at[0], y - held.at[1]) <= 3) return;
    if (!held.moved) { held.moved = true; pan = [held.at[0], held.at[1], x, y]; view.dataset.held = true; }
    else if (pan) { pan[2] = x; pan[3] = y; }
    ask();
  });
  const release = e => {
    if (!held) return;
    const was = held;
    held = null;
    delete view.dataset.held;
    if (was.moved) ask();
    else if (e.type === 'pointerup') dbh('photo-click', [was.frame, ...was.at]);
  };
  view.addEventListener('pointerup', release);
  view.addEventListener('pointercancel', release);
  view.addEventListener('wheel', e => {
    e.preventDefault();
    e.stopPropagation();
    if (!frame) return;
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
    open(name, position, hint, picks) {
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
      held = pan = wheel = null;
    },
    frame(number, source, list, hint, picks) {
      image.src = source;
      image.hidden = marks.hidden = false;
      text.hidden = true;
      foot.textContent = hint;
      view.dataset.picks = picks;
      frame = number;
      view.dataset.frame = number;
      asked = null;
      draw(list);
      ask();
    },
    close() { shown = isLarge = false; size = ''; frame = 0; place(); },
  };
})();
