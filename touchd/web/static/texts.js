// Every text of the page. To translate it, translate the right-hand sides.
export const texts = {
  language: 'en',
  title: 'touchd',
  views: { live: 'Live', replay: 'Replay', check: 'Check' },
  navigation: 'Views',
  theme: { auto: 'Colours: system', light: 'Colours: light', dark: 'Colours: dark' },
  no_session: 'To act, open the address that touchd web printed at its start.',

  states: {
    starting: ['Starting', 'The daemon is opening its device.'],
    streaming: ['Working', 'Frames flow, and touches are placed.'],
    uncalibrated: ['Uncalibrated', 'Frames flow, and there is no model of this plate.'],
    stalled: ['Stalled', 'The device is there and sends no frames.'],
    lost: ['Device lost', 'The device is not there; the daemon waits for it.'],
    stopping: ['Stopped', 'The daemon has ended.'],
  },
  connecting: ['Connecting', 'The page asks touchd web.'],
  no_server: ['No connection', 'touchd web does not answer. The page keeps trying.'],
  no_daemon: ['No daemon', 'No daemon publishes on this bus. systemctl status touchd'],
  silent: s => [`No data for ${s} s`, 'The daemon says nothing. What is shown is old.'],
  late: s => [`Late by ${s} s`, 'The computer is too busy to keep up with the frames.'],
  keypad_hidden: 'Keypad: touches are not shown, since they tell the PIN.',

  plate: {
    label: 'The plate, to scale, with the fingers on it',
    unknown: 'The plate’s size is not known yet.',
    emitter: 'E',
    screen: 'screen',
    mm: 'mm',
    fingers: n => (n === 0 ? 'No finger on the plate' : n === 1 ? '1 finger on the plate' : `${n} fingers on the plate`),
  },
  fingers: {
    title: 'Fingers',
    none: 'No finger on the plate.',
    columns: ['No.', 'Position', 'Std. error', 'Force', 'Kind', 'Off truth'],
    kinds: { finger: 'finger', thumb: 'thumb', glove: 'glove', palm: 'palm', water: 'water', object: 'object' },
    unknown: '–',
  },
  figures: {
    title: 'Health',
    latency: ['Latency, 99 %', 'From the complete frame to the message sent.'],
    rate: ['Frames', 'Taken in each second.'],
    lost: ['Lost', 'Frames that never came, since the start.'],
    noise: ['Noise', 'RMS of the untouched plate, ADC counts.'],
    temperature: ['Temperature', 'Against the model’s training, by the plate’s resonances.'],
    model_fit: ['Model fit', 'Share of a touch that the model explains; below 96 % calibrate again.'],
    baseline: ['Baseline', 'Time since the plate was last untouched.'],
    clock: ['Clock', 'How much faster the device’s clock runs.'],
  },
  budget: {
    title: 'Where the frames go',
    per_second: n => `${n} /s`,
    names: {
      inferred: 'network', tracking: 'followed', still: 'still', faint: 'faint', gate: 'untouched', learning: 'learning',
      'screen-off': 'screen off', uncalibrated: 'no model', frozen: 'frozen', repeated: 'repeated', behind: 'behind',
      lost: 'lost', corrupt: 'corrupt',
    },
  },
  latency: { title: 'Latency', p50: 'median', p99: '99 %', unit: 'ms', past: 'seconds ago' },
  noise: { title: 'Noise of each channel', channel: n => `Channel ${n}`, none: 'Not measured yet: leave the plate untouched.' },
  spectrum: {
    title: 'Residual’s spectrum', none: 'Touch the plate.', channel: n => `ch ${n}`, frequency: 'kHz', level: 'counts',
  },
  footer: (version, model, source) => `touchd ${version} · model ${model || '–'} · source ${source || '–'}`,
  age: ms => `data ${ms} ms old`,

  check: {
    title: 'Examination',
    hint: 'Checks bus, model, device, frames and computer. Leave the plate untouched meanwhile.',
    start: 'Examine', again: 'Examine again', running: 'Examining …',
    progress: n => `${n} checks done`,
    verdict: (all, failures, warnings) =>
      failures ? `${failures} of ${all} checks failed` : warnings ? `No failure, ${warnings} warnings` : `All ${all} checks passed`,
    levels: { ok: '✓ ok', warning: '! warning', failure: '✕ failure' },
    fix: 'What to do:',
    failed: 'That did not work: touchd web did not do it.',
    bundle: {
      title: 'Support bundle',
      hint: 'A file for whoever helps you: configuration without keys, five minutes of health, the examination, the last lines of the log.',
      recording: 'Add five seconds of frames. Whoever has them can work out a PIN that is typed meanwhile.',
      button: 'Download',
      making: 'Gathering …', recording_now: 'Recording five seconds …', done: 'Done: touchd-support.zip',
    },
  },

  units: { ms: 'ms', us: 'µs', s: 's', per_s: '/s', counts: 'counts', kelvin: 'K', ppm: 'ppm', percent: '%', mm: 'mm' },
};
