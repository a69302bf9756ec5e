// The plate with its discs as an SVG in millimetres, for measures and taps.
import { colour } from './dom.js';
import { texts } from './texts.js';

const MOST_MM = 1e5; // as PLATE.toml
const SMALLEST_PX = 14, LARGEST_PX = 20; // of its letters
const SPACE = 'http://www.w3.org/2000/svg';

function shape(name, attributes, text) {
  const made = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// A map as a picture of one pixel each: the more error, the denser the accent.
function picture({ mm, top_mm: most }) {
  const canvas = document.createElement('canvas'), graphics = canvas.getContext('2d');
  [canvas.width, canvas.height] = [mm[0].length, mm.length];
  graphics.fillStyle = colour('accent');
  mm.forEach((row, y) => row.forEach((error, x) => {
    graphics.globalAlpha = 0.6 * Math.min(1, error / most);
    graphics.fillRect(x, y, 1, 1);
  }));
  return canvas.toDataURL();
}

// Whether a measure is one of a plate: an SVG refuses numbers beyond those of single precision.
function drawable(mm) {
  return Math.abs(mm) <= MOST_MM;
}

export function drawing(label) {
  const root = shape('svg', { class: 'plate-drawing', role: 'img', 'aria-label': label });
  let shown = '', asked = null;
  new ResizeObserver(() => asked && show(...asked)).observe(root);

  // A letter's size in mm of the plate, so that it can be read however large the drawing is.
  function letters(width, height) {
    const most = parseFloat(getComputedStyle(root).maxHeight) || 560, wide = root.clientWidth || 300;
    const px = Math.max(SMALLEST_PX, Math.min(LARGEST_PX, wide / 36)), margin = 2.8 * px;
    return px / Math.max(0.1, Math.min((wide - margin) / width, (most - margin) / height));
  }

  // Draws the plate; taps as dots, the target as a ring, `heat` (rows of mm, and the most) as a map below them.
  function show({ plate, discs }, taps = [], target = null, last = null, heat = null) {
    asked = [{ plate, discs }, taps, target, last, heat];
    const key = JSON.stringify([...asked, colour('accent'), root.clientWidth, innerHeight]);
    if (key === shown) return;
    shown = key;
    const width = plate.width_mm, height = plate.height_mm;
    if (!(drawable(width) && drawable(height) && width > 0 && height > 0)) { root.replaceChildren(); return; }
    const large = Math.max(width, height), radius = drawable(plate.corner_radius_mm) ? plate.corner_radius_mm : 0;
    const size = letters(width, height), edge = 2 * size;
    root.setAttribute('viewBox', `${-edge} ${-edge} ${width + 1.4 * edge} ${height + 1.4 * edge}`);
    const found = [
      shape('rect', { class: 'glass', x: 0, y: 0, width, height, rx: Math.max(radius, 1) }),
      shape('text', { class: 'length', x: width / 2, y: -size / 2, 'font-size': size }, texts.drawing.width(width)),
      shape('text', { class: 'length', x: -height / 2, y: -size / 2, 'font-size': size, transform: 'rotate(-90)' }, texts.drawing.height(height)),
    ];
    if (heat) found.splice(1, 0, shape('image', { href: picture(heat), x: 0, y: 0, width, height, preserveAspectRatio: 'none' }));
    for (const [index, [x, y]] of [discs.emitter_mm, ...discs.receivers_mm].entries()) {
      if (!drawable(x) || !drawable(y)) continue;
      const r = Math.max(drawable(discs.diameter_mm) ? discs.diameter_mm / 2 : 0, large / 80);
      found.push(shape('circle', { class: index ? 'disc' : 'disc emitter', cx: x, cy: y, r }));
      found.push(shape('text', { class: 'name', x, y: y - r, 'font-size': size, dy: '-0.25em' }, index ? `${index}` : texts.plate.emitter));
    }
    for (const tap of taps) found.push(shape('circle', { class: 'tap', cx: tap.target_mm[0], cy: tap.target_mm[1], r: large / 110 }));
    if (last && !last.ok) found.push(shape('circle', { class: 'tap missed', cx: last.target_mm[0], cy: last.target_mm[1], r: large / 110 }));
    if (target) {
      found.push(shape('circle', { class: 'target', cx: target[0], cy: target[1], r: large / 40, 'data-x': target[0], 'data-y': target[1] }));
      found.push(shape('circle', { class: 'target middle', cx: target[0], cy: target[1], r: large / 300 }));
    }
    root.replaceChildren(...found);
  }
  return { root, show };
}
