// The form of what a person measures, with its drawing.
import { element } from './dom.js';
import { drawing } from './drawing.js';

const START = {
  plate: { width_mm: 200, height_mm: 200, thickness_mm: 5, material: 'glass', edge: 'free' },
  discs: { diameter_mm: 6, emitter_mm: [100, 40], receivers_mm: [[20, 20], [180, 20], [180, 180], [20, 180]] },
};

export function measures(t, save) {
  const picture = drawing(t.drawing);
  const fields = element('div', { class: 'measures' });
  const root = element('form', { class: 'measuring', onsubmit: event => { event.preventDefault(); save(read()); } },
    element('div', {}, fields,
      element('div', { class: 'row' },
        element('button', { type: 'submit', class: 'primary' }, t.save),
        element('button', { type: 'button', onclick: () => change(all => all.push([10, 10])) }, t.more),
        element('button', { type: 'button', onclick: () => change(all => all.length > 1 && all.pop()) }, t.less))),
    picture.root);
  root.addEventListener('input', draw);
  root.addEventListener('change', event => event.target.name === 'edge' && change(() => {}));
  let shown = null, kept = {}; // what a PLATE.toml says beyond the form

  function input(name, text, value) {
    return element('label', {}, element('span', {}, text),
      element('input', { name, value: String(value ?? ''), inputmode: 'decimal', autocomplete: 'off', required: '' }));
  }
  function select(name, text, options, value) {
    return element('label', {}, element('span', {}, text), element('select', { name },
      ...Object.entries(options).map(([key, label]) => element('option', { value: key, ...(key === value && { selected: '' }) }, label))));
  }

  function fill({ plate, discs }) {
    const sides = typeof plate.edge === 'object';
    const materials = Object.fromEntries(t.materials.map(name => [name, name]));
    const place = (name, text, [x, y]) => element('fieldset', {}, element('legend', {}, text),
      input(`${name}.x`, t.x, x), input(`${name}.y`, t.y, y));
    fields.replaceChildren(
      ...['width_mm', 'height_mm', 'thickness_mm'].map(name => input(name, t[name], plate[name])),
      select('material', t.material, { ...materials, ...(kept.plate?.young_gpa && { '': t.constants }) }, plate.material ?? ''),
      select('sheet', t.sheet, t.sheets, plate.rolled ? 'rolled' : 'even'),
      select('edge', t.edge, { ...t.edges, each: t.each }, sides ? 'each' : plate.edge ?? 'free'),
      ...(sides ? Object.entries(t.sides).map(([side, text]) => select(`edge.${side}`, `${t.edge}: ${text}`, t.edges, plate.edge[side] ?? 'free')) : []),
      input('diameter_mm', t.diameter_mm, discs.diameter_mm), place('emitter', t.emitter, discs.emitter_mm),
      ...discs.receivers_mm.map((at, index) => place(`receiver${index}`, t.receiver(index + 1), at)));
    draw();
  }

  function read() {
    const said = Object.fromEntries(new FormData(root)), value = name => parseFloat(String(said[name]).replace(',', '.'));
    const place = name => [value(`${name}.x`), value(`${name}.y`)], receivers_mm = [];
    while (`receiver${receivers_mm.length}.x` in said) receivers_mm.push(place(`receiver${receivers_mm.length}`));
    const edge = said.edge !== 'each' ? said.edge : Object.fromEntries(Object.keys(t.sides).map(side => [side, said[`edge.${side}`] ?? 'free']));
    const material = said.material ? { material: said.material, young_gpa: undefined, poisson: undefined, density_kg_m3: undefined } : {};
    return {
      ...kept,
      plate: { ...kept.plate, width_mm: value('width_mm'), height_mm: value('height_mm'), thickness_mm: value('thickness_mm'), ...material, rolled: said.sheet === 'rolled', edge },
      discs: { ...kept.discs, diameter_mm: value('diameter_mm'), emitter_mm: place('emitter'), receivers_mm },
    };
  }

  function change(how) {
    const now = read();
    how(now.discs.receivers_mm);
    fill(now);
  }

  function draw() {
    picture.show(read());
  }

  fill(START);
  // Takes what the wizard knows, once: what is being typed stays.
  function show(plate) {
    const key = JSON.stringify(plate);
    if (!plate || key === shown) return;
    shown = key;
    kept = plate;
    fill(plate);
  }
  return { root, show };
}
