// Small helpers for elements, numbers and colours.
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith('on')) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, '');
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// Writes only what differs: an unchanged text costs no layout.
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function number(value, digits = 0) {
  return Number.isFinite(value) ? value.toFixed(digits) : '–';
}

// So many of the page's letter sizes, px.
export function rem(count) {
  return count * parseFloat(getComputedStyle(document.documentElement).fontSize);
}

// The colours of page.css as the canvas needs them; forgotten when the theme changes.
const known = new Map();
let probe;
export function colour(name) {
  if (!known.has(name)) {
    probe ??= document.body.appendChild(element('i', { hidden: true }));
    probe.style.color = `var(--${name})`;
    known.set(name, getComputedStyle(probe).color);
  }
  return known.get(name);
}

const listeners = new Set();
export function onTheme(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}
export function themeChanged() {
  known.clear();
  for (const listener of listeners) listener();
}
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', themeChanged);

// Sends a POST and returns the answer; the session's cookie goes along.
export function post(path, body) {
  return fetch(path, { method: 'POST', body, headers: { 'content-type': 'text/plain' }, credentials: 'same-origin' });
}
