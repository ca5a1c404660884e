// Gestures in the pictures of one tree: round points that are not bark, the corners of a ring, the handle of breast
// height. What was drawn is sent in metres of the section; the picture itself never changes what is measured.
window.dbhSection = window.dbhSection || (() => {
  const NS = 'http://www.w3.org/2000/svg', SIZE = 340;
  const WORDS = {
    out: 'Draw round the points to leave out.',
    keep: 'Draw round the points to keep.',
    ring: 'Click corners along the bark; click the first one again, or press Enter, to close the ring.',
  };
  const LEAST = {out: 3, keep: 3, ring: 4};
  const AGAIN = {
    out: 'Hold the button down while you draw.',
    keep: 'Hold the button down while you draw.',
    ring: 'Four corners or more make a ring.',
  };
  let mode = null, corners = [], isDown = false, layer = null, handle = null;

  const picture = () => mode && document.querySelector(`.dbh-card[data-tree="${mode.tree}"] svg.dbh-section`);
  const place = (svg, event) => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    return [point.x, point.y];
  };
  const metres = (svg, [x, y]) => {
    const [u, v, half] = svg.dataset.frame.split(' ').map(Number);
    return [u + (2 * x / SIZE - 1) * half, v + (1 - 2 * y / SIZE) * half].map((m) => Math.round(m * 1e5) / 1e5);
  };
  function say(more = '') {
    document.querySelectorAll('.dbh-cut-tools button[data-draw]').forEach((button) => {
      button.setAttribute('aria-pressed', !!mode && mode.kind === button.dataset.draw);
    });
    const line = document.querySelector('.dbh-cut-hint');
    if (!line) return;
    line.textContent = mode ? `${more || WORDS[mode.kind]} Esc stops.` : '';
    const svg = picture();
    if (svg) svg.style.cursor = 'crosshair';
  }
  function draw() {
    const svg = picture();
    if (!svg) return;
    if (!layer || layer.ownerSVGElement !== svg) {
      layer = document.createElementNS(NS, 'g');
      layer.dataset.drawn = mode.kind;
      svg.appendChild(layer);
    }
    const path = corners.map((c) => c.map((x) => x.toFixed(1)).join(' ')).join('L');
    const dots = mode.kind === 'ring'
      ? corners.map((c) => `<circle cx="${c[0]}" cy="${c[1]}" r="5" fill="#fff" stroke="#e03131" stroke-width="2"/>`) : [];
    const fill = mode.kind === 'out' ? 'rgba(224,49,49,.15)' : mode.kind === 'keep' ? 'rgba(43,138,62,.15)' : 'none';
    layer.innerHTML = (path ? `<path d="M${path}${mode.kind === 'ring' ? '' : 'Z'}" fill="${fill}" stroke="#e03131" `
      + 'stroke-width="2.5" stroke-linejoin="round"/>' : '') + dots.join('');
  }
  function stop() {
    const svg = picture();
    if (svg) svg.style.cursor = svg.style.touchAction = '';
    if (layer) layer.remove();
    mode = layer = null;
    corners = [];
    isDown = false;
    say();
  }
  function begin(kind, tree, serial) {
    const again = mode && mode.kind === kind;
    stop();
    if (again) return;
    mode = {kind, tree, serial};
    const svg = picture();
    if (!svg) { mode = null; return; }
    svg.style.touchAction = 'none';
    svg.scrollIntoView({block: 'nearest'});
    say();
  }
  function send() {
    const svg = picture();
    if (svg && corners.length < LEAST[mode.kind]) {  // no more than a click: the tool stays in hand
      isDown = false;
      if (mode.kind !== 'ring') corners = [];
      draw();
      say(AGAIN[mode.kind]);
      return;
    }
    if (svg) dbh('section-draw', [mode.kind, mode.tree, mode.serial, corners.map((c) => metres(svg, c))]);
    stop();
  }
  const far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

  document.addEventListener('pointerdown', (event) => {
    const grip = event.target.closest && event.target.closest('[data-height-grip]');
    if (grip && event.button === 0) {
      handle = grip;
      handle.ownerSVGElement.style.touchAction = 'none';
      event.preventDefault();
      return;
    }
    const svg = picture();
    if (!svg || event.button !== 0 || !svg.contains(event.target)) return;
    event.preventDefault();
    const at = place(svg, event);
    if (mode.kind !== 'ring') {
      isDown = true;
      corners = [at];
    } else if (corners.length > 2 && far(at, corners[0]) < 12) {
      send();
    } else if (!corners.length || far(at, corners[corners.length - 1]) > 3) {
      corners.push(at);
      draw();
      say();
    }
  });
  document.addEventListener('pointermove', (event) => {
    if (handle) { drag(event); return; }
    const svg = picture();
    if (!isDown || !svg) return;
    const at = place(svg, event);
    if (far(at, corners[corners.length - 1]) > 2 && corners.length < 3000) {
      corners.push(at);
      draw();
    }
  });
  document.addEventListener('pointerup', (event) => {
    if (handle) { drop(event); return; }
    if (isDown) send();
  });
  // Before the page's own keys: what is being drawn has the first claim on them.
  const isMeantFor = (event, selector) => event.target instanceof Element && !!event.target.closest(selector);
  const isDecision = (event) => !event.ctrlKey && !event.metaKey && !event.altKey && /^[ lL]$/.test(event.key);
  function keyTaken(event) {
    if (isMeantFor(event, 'input,textarea,select,[contenteditable]')) return false;
    const decides = isDecision(event) && !isMeantFor(event, 'button');
    // A key that is held down repeats itself: one press is one decision.
    if (decides && event.repeat) return true;
    if (handle && event.key === 'Escape') { letGo(); return true; }
    if (mode && !picture()) stop();
    if (!mode) return false;
    if (event.key === 'Escape') stop();
    else if (mode.kind !== 'ring') { if (decides) say(); return decides; }
    else if (event.key === 'Enter') send();
    else if (corners.length && (event.key === 'Backspace' || ((event.ctrlKey || event.metaKey) && event.key === 'z'))) {
      corners.pop();
      draw();
    } else { if (decides) say('Press Enter to close the ring first.'); return decides; }
    return true;
  }
  window.addEventListener('keydown', (event) => {
    if (!keyTaken(event)) return;
    event.stopImmediatePropagation();
    event.preventDefault();
  }, true);
  // A button that was clicked keeps the keyboard, and Space would press it again instead of accepting the tree.
  document.addEventListener('click', (event) => {
    const button = event.target.closest && event.target.closest('button');
    if (button && event.detail > 0 && button === document.activeElement) button.blur();
  });

  // ---- the handle of breast height in the picture of the profile
  function heightAt(event) {
    const svg = handle.ownerSVGElement, [left, right, bottom, top] = handle.dataset.scale.split(' ').map(Number);
    const x = Math.min(Math.max(place(svg, event)[0], left), right);
    return [x, bottom + (top - bottom) * (x - left) / (right - left)];
  }
  function drag(event) {
    const [x, height] = heightAt(event);
    handle.setAttribute('transform', `translate(${(x - Number(handle.dataset.x)).toFixed(1)} 0)`);
    handle.querySelector('text').textContent = `${height.toFixed(2)} m`;
  }
  function drop(event) {
    const [, height] = heightAt(event), tree = Number(handle.dataset.tree);
    if (Math.abs(height - Number(handle.dataset.height)) > 0.004) {
      dbh('height-set', [tree, Math.round(height * 100) / 100]);
    }
    handle = null;
  }
  function letGo() {
    handle.removeAttribute('transform');
    handle.querySelector('text').textContent = `${Number(handle.dataset.height).toFixed(2)} m`;
    handle = null;
  }
  return {begin, stop};
})();
