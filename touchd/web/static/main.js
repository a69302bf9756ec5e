// The page: takes the token, shows the view that the address names, holds what all views share.
import { element, post, say, themeChanged } from './dom.js';
import { Feed } from './socket.js';
import { texts } from './texts.js';
import * as calibrate from './calibrate.js';
import * as check from './check.js';
import * as live from './live.js';
import * as replay from './replay.js';

// Each has `mount(root, page)`, which returns what ends it.
const VIEWS = { live, replay, calibrate, check };
const TOKEN = '#token=';

const views = document.getElementById('views'), root = document.getElementById('view');
const page = { texts, feed: null, hello: {} };
window.touchd = page; // for tests and the curious
let unmount = null, shown = null;

async function start() {
  document.documentElement.lang = texts.language;
  document.title = texts.title;
  views.setAttribute('aria-label', texts.navigation);
  setUpTheme();
  if (location.hash.startsWith(TOKEN)) {
    const token = location.hash.slice(TOKEN.length);
    history.replaceState(null, '', location.pathname + location.search);
    await post('session', token).catch(() => null);
  }
  page.feed = new Feed();
  page.feed.on('hello', hello => {
    page.hello = hello;
    list();
    if (hello.replay && !location.hash) location.hash = '#replay';
  });
  for (const type of ['health', 'plate']) page.feed.on(type, message => say(document.getElementById('device'), message.device));
  // An address with a token that is opened in this page is that of another start of the server.
  addEventListener('hashchange', () => (location.hash.startsWith(TOKEN) ? location.reload() : show()));
  list();
  show();
}

function list() {
  const names = Object.keys(VIEWS).filter(name => !VIEWS[name].available || VIEWS[name].available(page));
  if (names.join() !== views.dataset.names) {
    views.dataset.names = names.join();
    views.replaceChildren(...names.map(name => element('a', { href: `#${name}` }, texts.views[name])));
  }
  mark();
}

function mark() {
  for (const link of views.children) {
    if (link.hash === `#${shown}`) link.setAttribute('aria-current', 'page');
    else link.removeAttribute('aria-current');
  }
}

function show() {
  const name = location.hash.slice(1) in VIEWS ? location.hash.slice(1) : Object.keys(VIEWS)[0];
  if (name === shown) return;
  unmount?.();
  root.replaceChildren();
  root.className = name;
  shown = name;
  unmount = VIEWS[name].mount(root, page);
  mark();
}

function setUpTheme() {
  const button = document.getElementById('theme'), themes = ['auto', 'light', 'dark'];
  const apply = theme => {
    document.documentElement.dataset.theme = theme;
    button.dataset.theme = theme;
    button.setAttribute('aria-label', texts.theme[theme]);
    button.title = texts.theme[theme];
    say(button, { auto: '◐', light: '☀', dark: '☾' }[theme]);
    themeChanged();
  };
  let theme = localStorage.getItem('touchd-theme');
  if (!themes.includes(theme)) theme = 'auto';
  button.addEventListener('click', () => {
    theme = themes[(themes.indexOf(theme) + 1) % themes.length];
    localStorage.setItem('touchd-theme', theme);
    apply(theme);
  });
  apply(theme);
}

start();
