/* Which page this is, and whether the studio can be reached. The names outlive a lost connection, a reload and a page
   that the browser put to sleep. Each connection has one of its own: the browser hands those of a page on to its copy,
   and the two must not be taken for one. Several are said, for the latest may never have arrived. */
(() => {
  const key = 'dbh-pages';
  let names = window.dbhPages;
  try { names = names || JSON.parse(sessionStorage.getItem(key)); } catch (error) { /* the browser keeps nothing */ }
  names = Array.isArray(names) ? names.filter(each => typeof each === 'string') : [];
  const name = Array.from({length: 4}, () => Math.random().toString(36).slice(2, 8)).join('');
  dbh('page', [name, names]);
  window.dbhPages = [name, ...names].slice(0, 9);
  try { sessionStorage.setItem(key, JSON.stringify(window.dbhPages)); } catch (error) { /* as above */ }
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
