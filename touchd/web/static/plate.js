// The pane to scale on a canvas: discs, screen, keys, fingers with standard error and trail, truth.
import { colour, element, onTheme } from './dom.js';

const TRAIL_MS = 1500, TRAIL_POINTS = 200, MOST_TRAILS = 32;
const UP_MS = 250; // a lifted finger fades
const FINGER_MM = 9; // drawn where no size is known
const SMALLEST_PX = 14, LARGEST_PX = 22, PLATE_LETTERS = 60; // of the letters, and how many make the plate's side
const DISC_MM = 10;

export class PlateView {
  constructor(texts) {
    this.texts = texts;
    this.canvas = element('canvas', { role: 'img', 'aria-label': texts.plate.label });
    this.root = element('div', { class: 'pane' }, this.canvas);
    this.graphics = this.canvas.getContext('2d');
    this.plate = null;
    this.screen = [];
    this.contacts = [];
    this.truth = []; // where the fingers really are: [[x, y], ...], mm
    this.trails = new Map(); // id -> points {x, y, at}
    this.gone = new Map(); // id -> {contact, at}
    this.stale = false;
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.root);
    this.endTheme = onTheme(() => this.draw());
  }

  close() {
    this.observer.disconnect();
    this.endTheme();
    cancelAnimationFrame(this.frame);
  }

  set(name, value) {
    if (this[name] === value) return;
    this[name] = value;
    this.draw();
  }

  setContacts(contacts) {
    const at = performance.now(), seen = new Set();
    for (const contact of contacts) {
      seen.add(contact.id);
      const trail = this.trails.get(contact.id) ?? [];
      if (!trail.length) this.trails.set(contact.id, trail);
      trail.push({ x: contact.x_mm, y: contact.y_mm, at });
      if (trail.length > TRAIL_POINTS) trail.shift();
      if (contact.phase === 'up') this.gone.set(contact.id, { contact, at });
    }
    for (const contact of this.contacts) if (!seen.has(contact.id)) this.gone.set(contact.id, { contact, at });
    this.contacts = contacts.filter(contact => contact.phase !== 'up');
    while (this.trails.size > MOST_TRAILS) this.trails.delete(this.trails.keys().next().value);
    this.draw();
  }

  clear() {
    this.contacts = [];
    this.truth = [];
    this.trails.clear();
    this.gone.clear();
    this.draw();
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const { clientWidth: wide, clientHeight: high } = this.root;
    if (!wide || !high) return;
    this.canvas.width = Math.round(wide * ratio);
    this.canvas.height = Math.round(high * ratio);
    this.ratio = ratio;
    this.paint();
  }

  draw() {
    this.frame ??= requestAnimationFrame(() => { this.frame = null; this.paint(); });
  }

  paint() {
    const g = this.graphics, ratio = this.ratio;
    if (!ratio) return;
    const wide = this.canvas.width / ratio, high = this.canvas.height / ratio, now = performance.now();
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, wide, high);
    const px = this.px = Math.max(SMALLEST_PX, Math.min(LARGEST_PX, Math.min(wide, high) / PLATE_LETTERS)), ruler = 2.8 * px;
    if (!this.plate?.width_mm) {
      this.write(this.texts.plate.unknown, wide / 2, high / 2, 'muted', 'center');
      return;
    }
    const { width_mm: w, height_mm: h } = this.plate;
    const scale = Math.min((wide - ruler - 1.6 * px) / w, (high - ruler - px) / h);
    this.scale = scale;
    this.left = (wide - ruler - 1.4 * px - w * scale) / 2 + ruler;
    this.top = (high - ruler - h * scale) / 2 + ruler;
    this.paintStill(w, h, [scale, ratio, this.canvas.width, this.canvas.height, this.screen, colour('pane')].join());
    g.globalAlpha = this.stale ? 0.35 : 1;
    const moving = this.paintTrails(now);
    const fading = this.paintGone(now);
    for (const contact of this.contacts) this.paintFinger(contact, 1);
    this.paintTruth();
    g.globalAlpha = 1;
    if (moving || fading) this.draw();
  }

  x(mm) { return this.left + mm * this.scale; }
  y(mm) { return this.top + mm * this.scale; }

  write(text, x, y, name, align = 'left', px = this.px) {
    const g = this.graphics;
    g.font = `${px}px system-ui, sans-serif`;
    g.fillStyle = colour(name);
    g.textAlign = align;
    g.textBaseline = 'middle';
    g.fillText(text, x, y);
  }

  // What no finger moves is painted once: letters cost most of a frame.
  paintStill(w, h, key) {
    if (this.stillKey !== key || this.stillPlate !== this.plate) {
      Object.assign(this, { stillKey: key, stillPlate: this.plate });
      this.still ??= document.createElement('canvas');
      Object.assign(this.still, { width: this.canvas.width, height: this.canvas.height });
      const moving = this.graphics;
      this.graphics = this.still.getContext('2d');
      this.graphics.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      this.paintPane(w, h);
      this.paintKeys();
      this.paintDiscs();
      this.graphics = moving;
    }
    this.graphics.setTransform(1, 0, 0, 1, 0, 0);
    this.graphics.drawImage(this.still, 0, 0);
    this.graphics.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
  }

  paintPane(w, h) {
    const g = this.graphics;
    g.fillStyle = colour('pane');
    g.strokeStyle = colour('edge');
    g.lineWidth = 1.5;
    g.beginPath();
    g.roundRect(this.x(0), this.y(0), w * this.scale, h * this.scale, 4);
    g.fill();
    g.stroke();
    const step = [10, 20, 50, 100, 200, 500].find(mm => mm * this.scale >= 3 * this.px) ?? 1000;
    g.lineWidth = 1;
    g.strokeStyle = colour('grid');
    g.beginPath();
    for (let mm = step; mm < w; mm += step) { g.moveTo(this.x(mm), this.y(0)); g.lineTo(this.x(mm), this.y(h)); }
    for (let mm = step; mm < h; mm += step) { g.moveTo(this.x(0), this.y(mm)); g.lineTo(this.x(w), this.y(mm)); }
    g.stroke();
    for (let mm = 0; mm <= w; mm += step) this.write(`${mm}`, this.x(mm), this.y(0) - this.px, 'muted', 'center');
    for (let mm = step; mm <= h; mm += step) this.write(`${mm}`, this.x(0) - 6, this.y(mm), 'muted', 'right');
    this.write(this.texts.plate.mm, this.x(0) - 0.7 * this.px, this.y(0) - this.px, 'muted', 'right');
    if (this.screen.length !== 4) return;
    const [sx, sy, sw, sh] = this.screen;
    g.strokeStyle = colour('accent');
    g.setLineDash([6, 4]);
    g.strokeRect(this.x(sx), this.y(sy), sw * this.scale, sh * this.scale);
    g.setLineDash([]);
    this.write(this.texts.plate.screen, this.x(sx) + 6, this.y(sy) + this.px, 'accent');
  }

  paintKeys() {
    const g = this.graphics;
    g.strokeStyle = colour('edge');
    g.lineWidth = 1;
    for (const key of this.plate.keys) {
      const wide = key.width_mm * this.scale, high = key.height_mm * this.scale;
      g.strokeRect(this.x(key.x_mm), this.y(key.y_mm), wide, high);
      this.write(key.name, this.x(key.x_mm) + wide / 2, this.y(key.y_mm) + high / 2, 'muted', 'center', Math.min(1.5 * this.px, high / 2));
    }
  }

  paintDiscs() {
    const places = this.plate.receivers_mm.map(([x, y], n) => [x, y, `${n + 1}`]);
    if (this.plate.emitter_mm) places.push([...this.plate.emitter_mm, this.texts.plate.emitter]);
    const g = this.graphics, radius = Math.max(0.75 * this.px, (DISC_MM / 2) * this.scale);
    for (const [x, y, name] of places) {
      g.beginPath();
      g.arc(this.x(x), this.y(y), radius, 0, 7);
      g.fillStyle = colour(name === this.texts.plate.emitter ? 'disc-emitter' : 'disc');
      g.fill();
      this.write(name, this.x(x), this.y(y) + 0.5, 'disc-text', 'center');
    }
  }

  paintTrails(now) {
    const g = this.graphics, alpha = g.globalAlpha;
    let any = false;
    g.lineWidth = 2.5;
    g.lineJoin = g.lineCap = 'round';
    for (const [id, trail] of this.trails) {
      while (trail.length && now - trail[0].at > TRAIL_MS) trail.shift();
      if (!trail.length) { this.trails.delete(id); continue; }
      any = true;
      g.strokeStyle = colour(`finger-${id % 5}`);
      // Four pieces of falling opacity: a path for each point would cost too much.
      for (let part = 0; part < 4; part += 1) {
        const from = Math.floor((trail.length * part) / 4), to = Math.min(trail.length - 1, Math.floor((trail.length * (part + 1)) / 4));
        if (to <= from) continue;
        g.globalAlpha = alpha * 0.2 * (part + 1);
        g.beginPath();
        g.moveTo(this.x(trail[from].x), this.y(trail[from].y));
        for (let n = from + 1; n <= to; n += 1) g.lineTo(this.x(trail[n].x), this.y(trail[n].y));
        g.stroke();
      }
    }
    g.globalAlpha = alpha;
    return any;
  }

  paintGone(now) {
    for (const [id, { contact, at }] of this.gone) {
      const left = 1 - (now - at) / UP_MS;
      if (left <= 0) this.gone.delete(id);
      else this.paintFinger(contact, left);
    }
    return this.gone.size > 0;
  }

  paintFinger(c, share) {
    const g = this.graphics, x = this.x(c.x_mm), y = this.y(c.y_mm), ink = colour(`finger-${c.id % 5}`), alpha = g.globalAlpha;
    const major = ((c.major_mm ?? FINGER_MM) / 2) * this.scale, minor = ((c.minor_mm ?? FINGER_MM) / 2) * this.scale;
    g.globalAlpha = alpha * share * (0.25 + 0.5 * Math.min(1, c.force));
    g.fillStyle = ink;
    g.beginPath();
    g.ellipse(x, y, major, minor, ((c.angle_deg ?? 0) * Math.PI) / 180, 0, 7);
    g.fill();
    g.globalAlpha = alpha * share;
    g.strokeStyle = ink;
    g.lineWidth = 2;
    g.setLineDash(c.major_mm === undefined ? [3, 3] : []);
    g.stroke();
    g.setLineDash([]);
    // The standard error: a ring, and a cross that shows the place where the ring is a point.
    const sigma = c.sigma_mm * this.scale;
    g.strokeStyle = colour('text');
    g.lineWidth = 1.5;
    g.beginPath();
    g.arc(x, y, Math.max(sigma, 1.5), 0, 7);
    g.moveTo(x - sigma - 6, y);
    g.lineTo(x - sigma - 1, y);
    g.moveTo(x + sigma + 1, y);
    g.lineTo(x + sigma + 6, y);
    g.stroke();
    const right = x < this.x(this.plate.width_mm * 0.8);
    this.write(`${c.id}`, x + (right ? 1 : -1) * (major + 8), y - minor - 4, 'text', right ? 'left' : 'right', 1.15 * this.px);
    g.globalAlpha = alpha;
  }

  paintTruth() {
    const g = this.graphics;
    g.strokeStyle = colour('truth');
    g.lineWidth = 2;
    for (const [x_mm, y_mm] of this.truth) {
      const x = this.x(x_mm), y = this.y(y_mm);
      g.beginPath();
      g.moveTo(x - 7, y - 7);
      g.lineTo(x + 7, y + 7);
      g.moveTo(x - 7, y + 7);
      g.lineTo(x + 7, y - 7);
      g.stroke();
    }
  }
}
