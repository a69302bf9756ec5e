// Which model runs: the one from before, or one on trial, which is kept or given back. Shown at every step.
import { element, say } from './dom.js';

export function trial(t, act) {
  const which = element('p', { class: 'verdict', role: 'status' });
  const take = element('button', { type: 'button', class: 'primary', onclick: () => act({ do: 'take' }) }, t.take);
  const back = element('button', { type: 'button', onclick: () => act({ do: 'rollback' }) }, t.rollback);
  const root = element('div', { class: 'row trial' }, which, take, back);

  // `before` is null without a trial, and empty where no model ran before it.
  function show({ runs, before, result, trained }) {
    const tried = before !== null;
    root.hidden = !tried && !result && !trained;
    say(which, tried ? [t.on_trial(t.models[runs]), before ? '' : t.first].filter(Boolean).join(' ') : t.in_use(t.models[runs]));
    which.dataset.level = tried ? 'warning' : runs ? 'ok' : '';
    take.hidden = !tried;
    back.hidden = !before;
  }
  return { root, show };
}
