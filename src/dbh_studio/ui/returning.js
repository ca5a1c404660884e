/* Which page this is, and whether the studio can be reached. The name outlives a lost connection, a reload and a page
   that the browser put to sleep; a second page has another. */
(() => {
  const key = 'dbh-page';
  let page = window.dbhPage;
  try { page = page || sessionStorage.getItem(key); } catch (error) { /* the browser keeps nothing */ }
  const returns = Boolean(page);
  page = page || Array.from({length: 4}, () => Math.random().toString(36).slice(2, 8)).join('');
  window.dbhPage = page;
  try { sessionStorage.setItem(key, page); } catch (error) { /* as above */ }
  dbh('page', [page, returns]);
  if (window.dbhWatch) return;
  // viser puts a function that only complains in the place of the one that sends.
  const isLost = () => String(window.__viserMutable.sendMessage).includes('is not connected');
  window.dbhWatch = setInterval(() => {
    const lost = isLost(), sign = document.getElementById('dbh-lost');
    if (lost && !sign) {
      const made = document.createElement('div');
      made.id = 'dbh-lost';
      made.setAttribute('role', 'status');
      made.style.cssText = 'position:fixed;top:0;left:0;right:0;z-index:10000;padding:8px 16px;text-align:center;' +
        'background:#fff3bf;color:#3d2f00;font:14px sans-serif;box-shadow:0 1px 4px #0004';
      made.textContent = 'The connection to the studio is lost. All that was done is saved; it is tried again while ' +
        'this page is in front. If it does not come back, start the studio again and open its new link.';
      document.body.appendChild(made);
    } else if (!lost && sign) sign.remove();
  }, 1000);
})();
