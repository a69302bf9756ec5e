// The whole screen with one mark to tap, where it lies on the screen: a cross, or the ring of a target.
import { element, say } from './dom.js';

export function stage(t, stop) {
  const mark = element('i', { class: 'mark', 'aria-hidden': 'true' });
  const text = element('p', { class: 'what', role: 'status' }), result = element('p', { class: 'result', role: 'status' });
  const end = element('button', { type: 'button', onclick: stop }, t.stop);
  const root = element('div', { class: 'stage', hidden: true, role: 'dialog', 'aria-modal': 'true', 'aria-label': t.label }, mark, element('div', { class: 'middle' }, text, result, end));
  let opening = false;
  for (const type of ['resize', 'fullscreenchange']) addEventListener(type, check);

  // A mark lies where its share of the page says only if the page is the whole screen, unscaled.
  function fills() {
    const whole = document.fullscreenElement || matchMedia('(display-mode: fullscreen)').matches
      || (Math.abs(innerWidth - screen.width) <= 1 && Math.abs(innerHeight - screen.height) <= 1);
    return Boolean(whole) && Math.abs((visualViewport?.scale ?? 1) - 1) < 0.01;
  }

  function check() {
    if (!root.hidden && !opening && !fills()) stop();
  }

  // Shows the stage; returns whether it fills the screen.
  async function open() {
    root.hidden = false;
    opening = true;
    if (!fills()) await root.requestFullscreen?.().catch(() => null);
    opening = false;
    if (fills()) { end.focus(); return true; }
    close();
    return false;
  }

  function close() {
    if (root.hidden) return;
    root.hidden = true;
    if (document.fullscreenElement === root) document.exitFullscreen().catch(() => null);
  }

  // Shows a mark at shares of the screen, or none.
  function show(kind, at, what, said = '', level = '') {
    root.dataset.kind = kind;
    mark.hidden = !at;
    if (at) Object.assign(mark.style, { left: `${100 * at[0]}%`, top: `${100 * at[1]}%` });
    say(text, what);
    say(result, said);
    result.dataset.level = level;
    root.dataset.side = at && at[1] < 0.5 ? 'low' : 'high'; // the words are not where the mark is
  }

  function remove() {
    close();
    for (const type of ['resize', 'fullscreenchange']) removeEventListener(type, check);
  }
  return { root, open, close, show, remove };
}

// Where a place of the plate is on the screen, as shares of its width and height from the top left of its picture.
export function onScreen([x_mm, y_mm], { screen_mm: [left, top, wide, high], rotate }) {
  const p = (x_mm - left) / wide, q = (y_mm - top) / high;
  return { 0: [p, q], 90: [q, 1 - p], 180: [1 - p, 1 - q], 270: [1 - q, p] }[rotate];
}
