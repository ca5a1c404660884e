// What is typed into a field of the card stays while the card is drawn anew: its text, its caret, the keyboard.
window.dbhCard = window.dbhCard || (() => {
  const FIELD = '.dbh-card .dbh-tape input';
  let typed = null;
  const isField = (e) => e.target instanceof Element && e.target.matches(FIELD);
  const note = (input) => {
    typed = {input, tree: Number(input.closest('.dbh-card').dataset.tree), text: input.value, hasKeyboard: true};
  };
  document.addEventListener('focusin', (e) => { if (isField(e)) note(e.target); });
  document.addEventListener('input', (e) => {
    if (!isField(e)) return;
    note(e.target);
    dbh('tape-typed', [typed.tree, typed.text]);
  });
  document.addEventListener('focusout', (e) => {
    const was = typed;
    // Later: a field that is drawn anew loses the keyboard as well, but nobody has gone elsewhere.
    if (was && e.target === was.input) setTimeout(() => {
      if (was.input.isConnected && document.activeElement !== was.input) was.hasKeyboard = false;
    });
  });
  new MutationObserver(() => {
    if (!typed || typed.input.isConnected) return;
    const card = document.querySelector('.dbh-card');
    if (card && Number(card.dataset.tree) !== typed.tree) typed = null;  // kept, or told, when one went on
    const input = typed && document.querySelector(FIELD);
    if (!input) return;
    const {selectionStart, selectionEnd} = typed.input;
    input.value = typed.text;
    typed.input = input;
    if (!typed.hasKeyboard) return;
    input.focus({preventScroll: true});
    input.setSelectionRange(selectionStart, selectionEnd);
  }).observe(document.body, {childList: true, subtree: true});
  return {
    // It was kept.
    forget() {
      typed = null;
      document.querySelectorAll(FIELD).forEach((input) => { input.value = ''; });
    },
  };
})();
