// The transport of a replay: where it stands (STATUS `replay`), play and pause, seek, speed. Who may not change it sees it.
import { $, element } from './panel.js';

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50, 'max']; // max: as fast as the machine can

export const speedName = (speed) => (speed === 'max' ? 'max' : `${speed}×`);
export function clock(seconds) {
  const s = Math.max(0, Math.floor(seconds)), minutes = Math.floor(s / 60);
  const two = (n) => `${n}`.padStart(2, '0');
  return minutes < 60 ? `${minutes}:${two(s % 60)}` : `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(s % 60)}`;
}

export class Transport {
  // `say(word, arguments)` sends a command.
  constructor(say) {
    this.say = say;
    this.replay = null;
    this.dragging = false;
    for (const speed of SPEEDS) {
      const option = element('option', speedName(speed));
      option.value = speed;
      $('speed').append(option);
    }
    $('play').onclick = () => say(this.playing ? 'PAUSE' : 'RESUME');
    $('speed').onchange = () => say('SEEK', { speed: $('speed').value === 'max' ? 'max' : +$('speed').value });
    $('seek').oninput = () => {
      this.dragging = true;
      $('played').textContent = clock(this.wanted);
    };
    $('seek').onchange = () => {
      this.dragging = false;
      say('SEEK', { t: this.replay.begin + this.wanted });
    };
  }

  get playing() {
    return this.was === 'playing';
  }

  get wanted() {
    return ($('seek').value / 1000) * (this.replay.end - this.replay.begin);
  }

  // `replay`: {state, begin, end, position, speed}, times in s; null when the daemon does not replay.
  show(replay, may) {
    this.replay = replay ?? null;
    this.at = performance.now();
    if (replay && replay.state !== 'seeking') this.was = replay.state; // a seek ends in the state it began in
    $('transport').hidden = !replay;
    if (!replay) return;
    $('length-of').textContent = clock(replay.end - replay.begin);
    $('play').firstElementChild.firstElementChild.setAttribute('href', this.playing ? '#i-pause' : '#i-play');
    this.speed(replay.speed);
    for (const id of ['play', 'seek', 'speed']) $(id).disabled = !may;
    this.move();
  }

  speed(speed) { // one that is not in the list is added
    const value = `${speed}`, list = [...$('speed').options];
    if (!list.some((option) => option.value === value)) {
      const option = element('option', speedName(speed));
      option.value = value;
      $('speed').append(option);
    }
    if (document.activeElement !== $('speed')) $('speed').value = value;
  }

  // Between two messages the place is carried on by its speed.
  move() {
    if (!this.replay || this.dragging) return;
    const { begin, end, position, state, speed } = this.replay;
    const carried = state === 'playing' && speed !== 'max' ? ((performance.now() - this.at) / 1000) * speed : 0;
    const place = Math.min(position + carried, end) - begin;
    $('played').textContent = clock(place);
    $('seek').value = end > begin ? (1000 * place) / (end - begin) : 0;
  }
}
