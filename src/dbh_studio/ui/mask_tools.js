// The row of buttons under the title of a photo whose mask is looked through or painted. It shows what the server says.
window.dbhMaskTools = window.dbhMaskTools || ((row, view) => {
  const make = (tag, name, parent, text) => {
    const e = document.createElement(tag);
    if (name) e.className = name;
    if (text) e.textContent = text;
    parent.appendChild(e);
    return e;
  };
  const act = (what, value) => dbh('mask-do', [what, value === undefined ? null : value]);
  const button = (parent, what, text, tip, action) => {
    const e = make('button', '', parent, text);
    e.type = 'button';
    e.title = tip;
    e.dataset.mask = what;
    e.addEventListener('click', action || (() => act(what)));
    return e;
  };
  const slider = (parent, what, tip, low, high) => {
    const e = make('input', '', parent);
    e.type = 'range';
    e.min = low;
    e.max = high;
    e.title = tip;
    e.dataset.mask = what;
    e.setAttribute('aria-label', tip);
    return e;
  };
  let state = null, size = 14;
  const look = make('div', 'line', row), label = make('label', '', look), on = make('input', '', label);
  on.type = 'checkbox';
  on.dataset.mask = 'on';
  label.append(' Mask');
  on.addEventListener('change', () => act('on', on.checked));
  const opacity = slider(look, 'opacity', 'How strong the colours of the mask are', 10, 100);
  opacity.addEventListener('input', () => act('opacity', Number(opacity.value)));
  const status = make('span', 'state', look);
  const review = make('div', 'line', row);
  const accept = button(review, 'accept', '\u2713 Accept (A)', 'This mask is right; go to the next one');
  const reject = button(review, 'reject', '\u2715 Reject (R)', 'Do not use this mask; go to the next one');
  const paint = button(review, 'paint', 'Repaint', 'Mend the mask with a brush');
  const tools = make('div', 'line', row);
  const add = button(tools, 'add', 'Add', 'Paint trunk: begun on a trunk it grows, begun beside it is a new one',
    () => act('tool', 'add'));
  const erase = button(tools, 'erase', 'Erase', 'No trunk here', () => act('tool', 'erase'));
  const box = button(tools, 'box', 'Click', 'Click a trunk, or drag a box round it, and the model outlines it',
    () => act('tool', 'box'));
  const brush = slider(tools, 'size', 'Size of the brush (keys + and -)', 2, 80);
  brush.addEventListener('input', () => { size = Number(brush.value); });
  brush.value = size;
  const undo = button(tools, 'undo', '\u21B6', 'Take the last stroke back (Ctrl+Z)');
  const done = button(tools, 'done', 'Done', 'Stop painting (Esc); every stroke is saved as you go');
  row.hidden = true;

  function show(next) {
    state = next;
    row.hidden = !state;
    if (!state) return;
    on.checked = state.on;
    if (document.activeElement !== opacity) opacity.value = state.opacity;
    opacity.disabled = !state.on;
    status.textContent = status.title = state.status;
    status.dataset.level = state.level;
    review.hidden = !!state.tool;
    tools.hidden = !state.tool;
    accept.hidden = reject.hidden = !state.has_mask;
    accept.setAttribute('aria-pressed', state.review === 'accepted');
    reject.setAttribute('aria-pressed', state.review === 'rejected');
    paint.textContent = state.has_mask ? 'Repaint' : 'Paint a mask';
    paint.disabled = !state.can_paint;
    box.hidden = !state.can_click;
    for (const each of [add, erase, box]) each.setAttribute('aria-pressed', state.tool === each.dataset.mask);
    brush.disabled = state.tool === 'box';
    undo.disabled = !state.can_undo;
  }
  function resize(step) {
    size = Math.max(2, Math.min(80, Math.round(size * (step > 0 ? 1.25 : 0.8)) + (step > 0 ? 1 : 0)));
    brush.value = size;
  }
  return {
    show,
    tool: () => state && state.on && !state.busy ? state.tool : '',
    radius: () => state && state.on && !state.busy && (state.tool === 'add' || state.tool === 'erase') ? size : 0,
    // Whether the key was one of these.
    key(key) {
      if (!state) return false;
      const k = key.toLowerCase();
      if (state.tool) {
        if (k === 'escape') act('done');
        else if (k === '+' || k === '=') resize(1);
        else if (k === '-') resize(-1);
        else return false;
        return true;
      }
      if (!state.has_mask || (k !== 'a' && k !== 'r')) return false;
      act(k === 'a' ? 'accept' : 'reject');
      return true;
    },
  };
});
