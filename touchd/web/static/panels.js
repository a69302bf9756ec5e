// The panels beside the plate. Each takes the messages whose types it has methods for; `past` takes old health messages.
import { colour, element, number, onTheme, rem, say } from './dom.js';

const POINTS = 300; // seconds of health
const CHART_MS = 100;
const LEAST_FIT = 0.97;
const font = () => `${rem(0.8)}px system-ui, sans-serif`;
// Of glass, the twin's only coefficient. Messages do not name the plate's material: others have others.
const PPM_PER_KELVIN = -45;

function panel(name, title, ...children) {
  return element('section', { class: `panel ${name}` }, element('h2', {}, title), ...children);
}

export class Fingers {
  constructor(texts) {
    this.texts = texts;
    const { columns } = texts.fingers;
    this.body = element('tbody');
    this.none = element('p', { class: 'muted' }, texts.fingers.none);
    this.table = element('table', { class: 'untrue', hidden: true },
      element('thead', {}, element('tr', {}, ...columns.map((name, n) => element('th', { scope: 'col', class: n === 5 ? 'off' : null }, name)))), this.body);
    this.root = panel('fingers', texts.fingers.title, this.none, this.table);
    this.drawn = 0;
    this.truths = new Map(); // frame -> places
  }

  // Of the same frame alone: a finger moves millimetres from one to the next.
  truth({ frame, contacts_mm }) {
    this.truths.set(frame, contacts_mm);
    if (this.truths.size > 16) this.truths.delete(this.truths.keys().next().value);
    this.table.classList.remove('untrue');
    if (this.shown?.frame === frame) this.compare(this.shown);
  }

  compare({ frame, contacts }) {
    const places = this.truths.get(frame);
    if (!places?.length) return;
    contacts.filter(c => c.phase !== 'up').forEach((c, n) => {
      const off = Math.min(...places.map(([x, y]) => Math.hypot(x - c.x_mm, y - c.y_mm)));
      const cell = this.body.children[n]?.children[5];
      if (cell) say(cell, `${number(off, 2)} ${this.texts.units.mm}`);
    });
  }

  touch(message) {
    const { contacts } = message;
    const now = performance.now(), down = contacts.filter(c => c.phase !== 'up');
    if (!message.now && now - this.drawn < CHART_MS && down.length === this.body.childElementCount) return; // nobody reads faster
    this.drawn = now;
    this.none.hidden = down.length > 0;
    this.table.hidden = down.length === 0;
    while (this.body.childElementCount > down.length) this.body.lastChild.remove();
    while (this.body.childElementCount < down.length)
      this.body.append(element('tr', {}, element('th', { scope: 'row' }), ...Array.from({ length: 5 }, (_, n) => element('td', { class: n === 4 ? 'off' : null }))));
    down.forEach((c, n) => this.fill(this.body.children[n].children, c));
    this.shown = message;
    this.compare(message);
  }

  fill([id, place, sigma, force, kind], c) {
    const { units, fingers } = this.texts;
    say(id, `${c.id}`);
    id.className = `ink-${c.id % 5}`;
    say(place, `${number(c.x_mm, 1)}, ${number(c.y_mm, 1)}`);
    say(sigma, `± ${number(c.sigma_mm, 2)} ${units.mm}`);
    say(force, `${number(100 * c.force)} ${units.percent}`);
    say(kind, `${c.key ? `${c.key} · ` : ''}${fingers.kinds[c.kind] ?? c.kind ?? fingers.unknown}`);
  }
}

export class Figures {
  constructor(texts) {
    this.texts = texts;
    this.values = {};
    const list = element('dl', { class: 'figures' });
    for (const name of ['latency', 'rate', 'lost', 'noise', 'temperature', 'model_fit', 'baseline', 'clock']) {
      const [title, meaning] = texts.figures[name];
      const value = element('span', { class: 'value' }, '–'), unit = element('span', { class: 'unit' });
      const item = element('div', { class: 'figure', title: meaning }, element('dt', {}, title), element('dd', {}, value, ' ', unit));
      this.values[name] = { value, unit, item };
      list.append(item);
    }
    this.values.model_fit.item.hidden = true;
    this.root = panel('numbers', texts.figures.title, list);
  }

  plate(plate) { this.plateSaid = plate; }

  health(h) {
    const { units } = this.texts, before = this.before;
    const set = (name, value, unit, level = '') => {
      say(this.values[name].value, value);
      say(this.values[name].unit, unit);
      this.values[name].item.dataset.level = level;
    };
    if (h.latency_us.max > 0) set('latency', number(h.latency_us.p99 / 1000, 2), units.ms);
    if (before && h.t_ns > before.t_ns && h.frames >= before.frames) {
      const rate = (h.frames - before.frames) / ((h.t_ns - before.t_ns) / 1e9), wanted = this.plateSaid?.rate_hz;
      if (h.t_ns - before.t_ns > 3e8) set('rate', number(rate), units.per_s, wanted && rate < 0.8 * wanted ? 'warning' : '');
    }
    set('lost', `${h.lost + h.corrupt}`, '', before && h.lost + h.corrupt > before.lost + before.corrupt ? 'warning' : '');
    set('noise', number(h.noise, 1), units.counts);
    const ppm = h.stretch_ppm, kelvin = ppm / PPM_PER_KELVIN, signed = value => (value > 0 ? '+' : '') + value;
    if (ppm !== undefined) set('temperature', signed(number(kelvin, 1)), units.kelvin, Math.abs(kelvin) > 5 ? 'warning' : '');
    this.values.model_fit.item.hidden = h.model_fit === undefined;
    if (h.model_fit !== undefined)
      set('model_fit', number(100 * h.model_fit, 1), units.percent, h.model_fit < LEAST_FIT ? 'warning' : '');
    set('baseline', number(h.baseline_age_s, h.baseline_age_s < 10 ? 1 : 0), units.s, h.baseline_age_s > 60 ? 'warning' : '');
    set('clock', h.clock_ppm ? signed(number(h.clock_ppm, 1)) : '–', h.clock_ppm ? units.ppm : '');
    this.before = h;
  }
}

// What became of the frames since the message before: a bar of shares.
export class Budget {
  constructor(texts) {
    this.texts = texts;
    this.bar = element('div', { class: 'bar', role: 'img', 'aria-label': texts.budget.title });
    this.legend = element('ul', { class: 'legend' });
    this.root = panel('budget', texts.budget.title, this.bar, this.legend);
    this.parts = {};
    for (const [name, label] of Object.entries(texts.budget.names)) {
      const piece = element('i', { class: `share-${name}` }), value = element('b');
      const item = element('li', { hidden: true }, element('i', { class: `share-${name}` }), label, ' ', value);
      this.bar.append(piece);
      this.legend.append(item);
      this.parts[name] = { piece, item, value };
    }
  }

  health(h) {
    const counts = { inferred: h.inferred, lost: h.lost, corrupt: h.corrupt, ...h.skipped }, before = this.before;
    const passed_s = before ? (h.t_ns - before.t_ns) / 1e9 : 0;
    if (!before || passed_s > 0.3 || passed_s < 0) this.before = { ...counts, t_ns: h.t_ns };
    if (passed_s <= 0.3) return;
    const grown = Object.keys(this.parts).map(name => [name, Math.max(0, (counts[name] ?? 0) - (before[name] ?? 0))]);
    for (const [name, n] of grown) {
      const { piece, item, value } = this.parts[name];
      piece.style.flexGrow = n;
      piece.hidden = n === 0;
      item.hidden = n === 0;
      say(value, this.texts.budget.per_second(Math.round(n / passed_s)));
    }
  }
}

// A chart that uPlot draws, as wide as its panel; at most ten times a second, and only where it is seen.
class Chart {
  constructor(root, options) {
    this.root = root;
    this.options = options;
    this.holder = element('div', { class: 'chart' });
    root.append(this.holder);
    this.resizing = new ResizeObserver(() => this.make());
    this.resizing.observe(this.holder);
    this.endTheme = onTheme(() => this.make(true));
  }

  make(again = false) {
    const { clientWidth: width } = this.holder, height = innerHeight >= 900 ? 230 : 150;
    if (!width) return;
    if (this.plot && !again) { this.plot.setSize({ width, height }); return; }
    this.plot?.destroy();
    const axis = { stroke: colour('muted'), grid: { stroke: colour('grid'), width: 1 }, ticks: { show: false }, font: font() };
    const { x, y, series } = this.options();
    this.plot = new uPlot({
      width, height, legend: { show: false }, cursor: { show: false }, padding: [8, 16, 0, 0],
      scales: { x: { time: false }, y: { range: (_plot, _low, high) => [0, Math.max(high * 1.1, 1e-3)] } },
      axes: [{ ...axis, size: rem(1.6), ...x }, { ...axis, size: rem(2.9), ...y }], series: [{}, ...series],
    }, this.data ?? [[], ...series.map(() => [])], this.holder);
  }

  set(data) {
    this.data = data;
    if (!this.plot || this.plot.series.length !== data.length) this.make(true);
    else this.plot.setData(data);
  }

  close() {
    this.resizing.disconnect();
    this.endTheme();
    this.plot?.destroy();
  }
}

function key(entries) {
  return element('ul', { class: 'legend' }, ...entries.map(([name, label]) => element('li', {}, element('i', { class: name }), label)));
}

export class LatencyChart {
  constructor(texts) {
    const { title, unit, p50, p99, past } = texts.latency;
    this.root = panel('latency', `${title}, ${unit}`, key([['line-1', p50], ['line-2', p99]]));
    this.points = [];
    this.chart = new Chart(this.root, () => ({
      x: { values: (_plot, at) => at.map(s => `${-s}`), label: past, labelSize: rem(1), labelFont: font(), size: rem(2.5) },
      y: {},
      series: ['line-1', 'line-2'].map(name => ({ stroke: colour(name), width: 1.5, points: { show: false } })),
    }));
  }

  past(h) { this.add(h); }

  health(h) {
    this.add(h);
    const now_ns = h.t_ns, shown = this.points;
    this.chart.set([shown.map(p => (p.t_ns - now_ns) / 1e9), shown.map(p => p.p50), shown.map(p => p.p99)]);
  }

  add(h) {
    const last = this.points.at(-1);
    if (last && h.t_ns < last.t_ns - 1e9) this.points = []; // the daemon's computer started again
    if (last && h.t_ns <= last.t_ns) return;
    const sent = h.latency_us.max > 0;
    this.points.push({ t_ns: h.t_ns, p50: sent ? h.latency_us.p50 / 1000 : null, p99: sent ? h.latency_us.p99 / 1000 : null });
    if (this.points.length > POINTS) this.points.shift();
  }

  close() { this.chart.close(); }
}

export class Noise {
  constructor(texts) {
    this.texts = texts;
    this.none = element('p', { class: 'muted' }, texts.noise.none);
    this.list = element('ul', { class: 'bars' });
    this.root = panel('noise', texts.noise.title, this.none, this.list);
  }

  health({ noise_channels: noise = [] }) {
    this.none.hidden = noise.length > 0;
    while (this.list.childElementCount > noise.length) this.list.lastChild.remove();
    while (this.list.childElementCount < noise.length)
      this.list.append(element('li', {}, element('span'), element('div', { class: 'track' }, element('i')), element('b')));
    const most = Math.max(...noise, 1e-9), middle = [...noise].sort((a, b) => a - b)[noise.length >> 1];
    noise.forEach((counts, n) => {
      const [name, track, value] = this.list.children[n].children;
      say(name, this.texts.noise.channel(n + 1));
      track.firstChild.style.width = `${(100 * counts) / most}%`;
      this.list.children[n].dataset.level = counts > 3.16 * middle ? 'warning' : ''; // doctor's 10 dB
      say(value, `${number(counts, 1)} ${this.texts.units.counts}`);
    });
  }
}

export class Spectrum {
  constructor(texts, feed) {
    this.texts = texts;
    this.none = element('p', { class: 'muted' }, texts.spectrum.none);
    this.legend = element('div');
    this.root = panel('spectrum', `${texts.spectrum.title}, ${texts.spectrum.level}`, this.none, this.legend);
    this.channels = 0;
    this.chart = new Chart(this.root, () => ({
      x: { label: texts.spectrum.frequency, labelSize: rem(1), labelFont: font(), size: rem(2.5) },
      y: {},
      series: Array.from({ length: this.channels }, (_, n) => ({ stroke: colour(`finger-${n % 5}`), width: 1.25, points: { show: false } })),
    }));
    // The daemon makes spectra only while this is in sight.
    this.sight = new IntersectionObserver(([entry]) => {
      if (entry.isIntersecting) this.end ??= feed.ask('spectrum');
      else { this.end?.(); this.end = null; }
    });
    this.sight.observe(this.root);
  }

  plate(plate) { this.said = plate; }

  spectrum({ features }) {
    const channels = this.said?.channels, bins = features.length / (2 * channels);
    if (!channels || !Number.isInteger(bins) || bins < 2) return;
    this.none.hidden = true;
    if (channels !== this.channels) {
      this.channels = channels;
      this.legend.replaceChildren(key(Array.from({ length: channels }, (_, n) => [`ink-${n % 5}`, this.texts.spectrum.channel(n + 1)])));
    }
    const [low, high] = this.said.band_hz, data = [Array.from({ length: bins }, (_, b) => (low + ((high - low) * b) / (bins - 1)) / 1000)];
    for (let c = 0; c < channels; c += 1) {
      const at = 2 * c * bins;
      data.push(Array.from({ length: bins }, (_, b) => Math.hypot(features[at + b], features[at + bins + b])));
    }
    this.chart.set(data);
  }

  close() {
    this.sight.disconnect();
    this.end?.();
    this.chart.close();
  }
}
