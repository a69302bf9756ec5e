// The replay view: one recording, its time line, and each frame of it.
import { colour, element, number, onTheme, say } from './dom.js';
import { PlateView } from './plate.js';
import { Fingers } from './panels.js';

const CHUNK = 500, MOST_CHUNKS = 8; // frames in memory: 4000
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

export const available = page => Boolean(page.hello.replay);

export function mount(root, page) {
  const { texts, feed } = page, t = texts.replay;
  const plate = new PlateView(texts), fingers = new Fingers(texts), chunks = new Map();
  let summary = null, at = 0, playing = false, begun = null, ended = false, speed = 1, wanted = null, last = null;

  const name = element('p', { class: 'muted' }), clock = element('div', { class: 'clock' }), outcome = element('div', { class: 'outcome', role: 'status' });
  const where = element('p', { class: 'muted' });
  const back = element('button', { type: 'button', 'aria-label': t.back, onclick: () => step(-1) }, '◀');
  const on = element('button', { type: 'button', 'aria-label': t.on, onclick: () => step(1) }, '▶');
  const play = element('button', { type: 'button', class: 'primary', onclick: toggle }, t.play);
  const line = element('input', { type: 'range', min: 0, max: 0, value: 0, 'aria-label': t.line, oninput: () => { pause(); go(Number(line.value)); } });
  const strip = element('canvas', { 'aria-hidden': 'true' });
  const rate = element('select', { 'aria-label': t.speed, onchange: () => { speed = Number(rate.value); begun = null; } },
    ...SPEEDS.map(value => element('option', { value, selected: value === 1 }, `${value}×`)));
  root.append(
    plate.root,
    element('div', { class: 'side', role: 'region', tabindex: 0, 'aria-label': t.title }, name, clock, outcome, where, fingers.root,
      element('p', { class: 'muted' }, t.keys)),
    element('div', { class: 'player' }, back, play, on, element('div', { class: 'timeline' }, line, strip), rate));
  say(name, page.hello.replay ?? '');

  async function load() {
    const answer = await fetch('replay').catch(() => null);
    if (ended || answer?.status === 202) return;
    if (!answer?.ok) { say(outcome, answer?.status === 401 ? texts.no_session : t.failed); return; }
    summary = await answer.json();
    plate.set('plate', summary.plate);
    line.max = summary.frames - 1;
    paintStrip();
    go(0);
  }

  async function chunk(index) {
    if (!chunks.has(index)) {
      chunks.set(index, fetch(`replay/frames?first=${index * CHUNK}&count=${CHUNK}`)
        .then(answer => answer.text()).then(text => text.trim().split('\n').map(JSON.parse))
        .catch(() => { chunks.delete(index); return []; }));
      if (chunks.size > MOST_CHUNKS) chunks.delete(chunks.keys().next().value);
    }
    return chunks.get(index);
  }

  async function go(frame) {
    if (!summary) return;
    wanted = at = Math.max(0, Math.min(summary.frames - 1, frame));
    const index = Math.floor(at / CHUNK), mine = at, frames = await chunk(index);
    if (ended || wanted !== mine) return; // another frame is wanted by now
    const shown = frames[mine - index * CHUNK];
    if (!shown) return;
    if (last === null || Math.abs(mine - last) > 20 || mine < last) plate.clear();
    last = mine;
    plate.setContacts(shown.contacts);
    plate.set('truth', shown.truth);
    if (shown.truth.length) fingers.truth({ frame: shown.frame, contacts_mm: shown.truth });
    fingers.touch({ frame: shown.frame, contacts: shown.contacts, now: !playing });
    say(clock, `${number(shown.t_s, 3)} ${texts.units.s}`);
    say(outcome, t.outcomes[shown.outcome] ?? shown.outcome);
    say(where, t.frame(mine + 1, summary.frames, shown.frame));
    line.value = mine;
    if (playing && mine - index * CHUNK > CHUNK / 2) chunk(index + 1);
  }

  function step(by) { pause(); go(at + by); }

  function toggle() { if (playing) pause(); else start(); }

  function start() {
    if (!summary) return;
    if (at >= summary.frames - 1) at = 0;
    playing = true;
    begun = null;
    say(play, t.pause);
    requestAnimationFrame(tick);
  }

  function pause() {
    if (!playing) return;
    playing = false;
    say(play, t.play);
    go(at); // with all figures
  }

  function tick(now) {
    if (!playing || ended) return;
    begun ??= { now, at };
    const frame = begun.at + Math.floor(((now - begun.now) / 1000) * speed * summary.plate.rate_hz);
    if (frame !== at) go(frame);
    if (frame >= summary.frames - 1) { at = summary.frames - 1; pause(); return; }
    requestAnimationFrame(tick);
  }

  function paintStrip() {
    if (!summary || !strip.clientWidth) return;
    const g = strip.getContext('2d'), wide = (strip.width = strip.clientWidth), high = (strip.height = 22);
    g.fillStyle = colour('grid');
    g.fillRect(0, 0, wide, high);
    g.fillStyle = colour('accent');
    const most = Math.max(...summary.fingers.map(([, count]) => count), 1);
    summary.fingers.forEach(([first, count], n) => {
      const end = summary.fingers[n + 1]?.[0] ?? summary.frames, tall = (count / most) * high;
      g.fillRect((first / summary.frames) * wide, high - tall, Math.max(1, ((end - first) / summary.frames) * wide), tall);
    });
  }

  function key(event) {
    if (event.target.matches('input, select, button')) return;
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (by) step(by);
    else if (event.key === ' ') toggle();
    else return;
    event.preventDefault();
  }

  document.addEventListener('keydown', key);
  const resizing = new ResizeObserver(paintStrip);
  resizing.observe(strip);
  const ends = [onTheme(paintStrip), feed.on('hello', hello => plate.set('screen', hello.screen_mm)), feed.on('replay', message => {
    if (message.ready) load();
    else say(outcome, message.problem || t.busy(message.done));
  })];
  say(outcome, t.busy(0));
  load();
  return () => {
    ended = true;
    document.removeEventListener('keydown', key);
    resizing.disconnect();
    for (const end of ends) end();
    plate.close();
  };
}
