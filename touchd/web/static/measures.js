// The form of what a person measures, with its drawing.
import { element } from './dom.js';
import { drawing } from './drawing.js';

const START = {
  plate: { width_mm: 200, height_mm: 200, thickness_mm: 5, material: 'glass', edge: 'free' },
  discs: { diameter_mm: 6, emitter_mm: [100, 40], receivers_mm: [[20, 20], [180, 20], [180, 180], [20, 180]] },
};

const NUMBER = /^\s*[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?\s*$/i;

const FULL_WIDTH = /[！-～]/g, PLAIN = 0xfee0; // as a Japanese keyboard types them

// A number, with a decimal point or comma; NaN of a text that is not wholly one: of "11 cm" a part would be wrong.
function numeric(text) {
  const plain = String(text).replace(FULL_WIDTH, letter => String.fromCharCode(letter.charCodeAt(0) - PLAIN));
  return NUMBER.test(plain) ? Number(plain.replace(',', '.')) : NaN;
}

export function measures(t, save) {
  // What is typed and not saved, while this tab lives: by path, since a proxy may have another plate at another one.
  const stored = `touchd-measures ${location.pathname}`;
  const picture = drawing(t.drawing);
  const fields = element('div', { class: 'measures' }), others = element('p', { class: 'muted', role: 'status', hidden: true }, t.others);
  const root = element('form', { class: 'measuring', onsubmit: submit },
    element('div', {}, fields, others,
      element('div', { class: 'row' },
        element('button', { type: 'submit', class: 'primary' }, t.save),
        element('button', { type: 'button', onclick: () => change(all => all.push([10, 10])) }, t.more),
        element('button', { type: 'button', onclick: () => change(all => all.length > 1 && all.pop()) }, t.less))),
    picture.root);
  root.addEventListener('input', event => { check(event.target); note(); draw(); });
  root.addEventListener('change', event => event.target.name === 'edge' && change(() => {}));
  let shown = null, kept = {}; // what a PLATE.toml says beyond the form
  let typed = false; // and not saved

  async function submit(event) {
    event.preventDefault();
    typed = false; // the wizard's next state has it
    typed = !await save(read()) || typed;
    others.hidden ||= !typed;
    if (!typed) sessionStorage.removeItem(stored);
  }

  // Keeps what is being typed: another view, or a reload, would lose it.
  function note() {
    typed = true;
    sessionStorage.setItem(stored, JSON.stringify({ typed: read(text => text), shown }));
  }

  // The browser shows at the field what is wrong there, and submits nothing.
  function check(field) {
    if (field.inputMode !== 'decimal') return;
    const group = field.closest('fieldset')?.querySelector('legend').textContent, name = field.closest('label').textContent;
    field.setCustomValidity(field.value && Number.isNaN(numeric(field.value)) ? t.no_number(group ? `${group}, ${name}` : name, field.value) : '');
  }

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
      input('corner_radius_mm', t.corner_radius_mm, plate.corner_radius_mm ?? 0),
      select('material', t.material, { ...materials, ...(kept.plate?.young_gpa && { '': t.constants }) }, plate.material ?? ''),
      select('sheet', t.sheet, t.sheets, plate.rolled ? 'rolled' : 'even'),
      select('edge', t.edge, { ...t.edges, each: t.each }, sides ? 'each' : plate.edge ?? 'free'),
      ...(sides ? Object.entries(t.sides).map(([side, text]) => select(`edge.${side}`, `${t.edge}: ${text}`, t.edges, plate.edge[side] ?? 'free')) : []),
      input('diameter_mm', t.diameter_mm, discs.diameter_mm), place('emitter', t.emitter, discs.emitter_mm),
      ...discs.receivers_mm.map((at, index) => place(`receiver${index}`, t.receiver(index + 1), at)));
    for (const field of fields.querySelectorAll('input')) check(field);
    draw();
  }

  // Returns what the form says, its numbers by `value_of` their texts.
  function read(value_of = numeric) {
    const said = Object.fromEntries(new FormData(root)), value = name => value_of(said[name]);
    const place = name => [value(`${name}.x`), value(`${name}.y`)], receivers_mm = [];
    while (`receiver${receivers_mm.length}.x` in said) receivers_mm.push(place(`receiver${receivers_mm.length}`));
    const edge = said.edge !== 'each' ? said.edge : Object.fromEntries(Object.keys(t.sides).map(side => [side, said[`edge.${side}`] ?? 'free']));
    const material = said.material ? { material: said.material, young_gpa: undefined, poisson: undefined, density_kg_m3: undefined } : {};
    return {
      ...kept,
      plate: { ...kept.plate, width_mm: value('width_mm'), height_mm: value('height_mm'), thickness_mm: value('thickness_mm'), corner_radius_mm: value('corner_radius_mm'), ...material, rolled: said.sheet === 'rolled', edge },
      discs: { ...kept.discs, diameter_mm: value('diameter_mm'), emitter_mm: place('emitter'), receivers_mm },
    };
  }

  function change(how) {
    const now = read(text => text); // one that is no number yet stays
    how(now.discs.receivers_mm);
    fill(now);
    note();
  }

  function draw() {
    picture.show(read());
  }

  const draft = JSON.parse(sessionStorage.getItem(stored));
  if (draft) [typed, shown, kept] = [true, draft.shown, draft.typed];
  fill(draft?.typed ?? START);
  // Takes what the wizard knows, once; what is being typed stays, and the person is told that others were saved.
  function show(plate) {
    const key = JSON.stringify(plate);
    if (!plate || key === shown) return;
    shown = key;
    others.hidden = !typed;
    if (typed) return;
    kept = plate;
    fill(plate);
  }
  return { root, show };
}
