// The training of a model on a labelled recording: what to train on and how, what came of it, and the log.
import { element, number, say } from './dom.js';

export function training(t, act) {
  const recording = element('input', { name: 'recording', autocomplete: 'off', spellcheck: 'false', maxlength: 4096, required: '' });
  const recipe = element('select', { name: 'recipe' }, ...Object.entries(t.recipes).map(([value, text]) => element('option', { value }, text)));
  const start = element('button', { type: 'submit', class: 'primary' }, t.start);
  const form = element('form', { onsubmit: event => { event.preventDefault(); act({ do: 'train', recording: recording.value, recipe: recipe.value }); } },
    element('div', { class: 'measures wide' }, element('label', {}, t.recording, recording), element('label', {}, t.recipe, recipe)),
    element('div', { class: 'row' }, start));
  const why = element('p', { class: 'fix', hidden: true });
  const result = element('p', { role: 'status' }), log = element('pre', { class: 'log', tabindex: 0, 'aria-label': t.log });
  const use = element('button', { type: 'button', onclick: () => act({ do: 'try', model: 'trained' }) }, t.try);
  const root = element('div', {}, form, why, result, element('div', { class: 'row' }, use), log);
  let known = null;

  function show({ running, training: asked, trained, untrainable, runs, log: lines }) {
    const key = JSON.stringify(asked);
    if (asked && key !== known) { // once: what is being typed stays
      known = key;
      [recording.value, recipe.value] = [asked.recording, asked.recipe];
    }
    form.hidden = running === 'train';
    start.disabled = Boolean(untrainable);
    say(why, untrainable ? t.untrainable(untrainable.replaceAll(' -> ', ' → ')) : '');
    why.hidden = !untrainable;
    say(result, trained && running !== 'train' ? `${t.trained(number(trained.scores.median_mm, 2), trained.scores.n)}` : '');
    use.hidden = !trained || running === 'train' || runs === 'trained';
    const low = log.scrollTop + log.clientHeight >= log.scrollHeight - 4;
    say(log, lines.join('\n'));
    log.hidden = !lines.length;
    if (low) log.scrollTop = log.scrollHeight;
  }
  return { root, show };
}
