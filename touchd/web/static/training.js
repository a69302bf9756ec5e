// The training of a model on a labelled recording: what to train on and how, what came of it, and the log.
import { element, number, say } from './dom.js';

export function training(t, act) {
  const recording = element('input', { name: 'recording', autocomplete: 'off', spellcheck: 'false', required: '' });
  const recipe = element('select', { name: 'recipe' }, ...Object.entries(t.recipes).map(([value, text]) => element('option', { value }, text)));
  const start = element('button', { type: 'submit', class: 'primary' }, t.start);
  const form = element('form', { onsubmit: event => { event.preventDefault(); act({ do: 'train', recording: recording.value, recipe: recipe.value }); } },
    element('div', { class: 'measures wide' }, element('label', {}, t.recording, recording), element('label', {}, t.recipe, recipe)),
    element('div', { class: 'row' }, start));
  const why = element('p', { class: 'fix', hidden: true });
  const result = element('p', { role: 'status' }), log = element('pre', { class: 'log', tabindex: 0, 'aria-label': t.log });
  const use = element('button', { type: 'button', onclick: () => act({ do: 'install', model: 'trained' }) }, t.install);
  const back = element('button', { type: 'button', onclick: () => act({ do: 'rollback' }) }, t.rollback);
  const root = element('div', {}, form, why, result, element('div', { class: 'row' }, use, back), log);
  let known = null;

  function show({ running, training: asked, trained, untrainable, installed, log: lines }) {
    const key = JSON.stringify(asked);
    if (asked && key !== known) { // once: what is being typed stays
      known = key;
      [recording.value, recipe.value] = [asked.recording, asked.recipe];
    }
    form.hidden = running === 'train';
    start.disabled = Boolean(untrainable);
    say(why, untrainable ? t.untrainable(untrainable.replaceAll(' -> ', ' → ')) : '');
    why.hidden = !untrainable;
    const inUse = installed === 'trained';
    say(result, trained && running !== 'train' ? `${t.trained(number(trained.scores.median_mm, 2), trained.scores.n)}${inUse ? ` ${t.installed}` : ''}` : '');
    use.hidden = !trained || running === 'train' || inUse;
    back.hidden = !inUse;
    const low = log.scrollTop + log.clientHeight >= log.scrollHeight - 4;
    say(log, lines.join('\n'));
    log.hidden = !lines.length;
    if (low) log.scrollTop = log.scrollHeight;
  }
  return { root, show };
}
