// SPDX-License-Identifier: Apache-2.0

if (!document.createElement('canvas').getContext('webgl2')) {
  location.replace(`${place}plain`);
}

// viser's page waits for ever if the door has no place for one more page with the scene.
const looking = setInterval(async () => {
  const state = await fetch(`${place}state`).then(answer => answer.json()).catch(() => null);
  if (state?.is_full) {
    location.replace(`${place}plain`);
  }
}, 2000);

// Until the panels of the flight are there, viser shows a panel of its own: "loading" covers it.
const waiting = setInterval(() => {
  const panels = document.querySelector('#root:has([role=tab])');
  if (panels && (find('Hold') || panels.textContent.includes('Read only'))) {
    clearInterval(looking);
    clearInterval(waiting);
    document.getElementById('loading').remove();
  }
}, 100);

// viser's buttons tell that they are held, its keys do not: a held key holds the button of its name.
const drive = KEYS;
const held = new Set();
const find = text =>
  [...document.querySelectorAll('button')].find(button => button.textContent.trim() === text);

function press(kind, code) {
  const options = {bubbles: true, button: 0, pointerId: 9};
  find(drive[code])?.dispatchEvent(new PointerEvent(kind, options));
}

function release(code) {
  if (held.delete(code)) {
    press('pointerup', code);
    find(drive[code])?.click();
  }
}

function releaseAll() {
  [...held].forEach(release);
}

function seize(event) {
  event.preventDefault();
  event.stopImmediatePropagation();
}

window.addEventListener('keydown', event => {
  if (event.key === 'Meta') {
    releaseAll();  // macOS tells no release of a key while Command is held
  }
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest('input, textarea')) {
    return;
  }
  if (event.code === 'Space' && find('Hold')) {
    seize(event);
    if (!event.repeat) {
      find('Hold').click();
    }
  } else if (event.code in drive && find(drive[event.code])) {
    seize(event);
    if (!event.repeat && !held.has(event.code)) {
      held.add(event.code);
      press('pointerdown', event.code);
    }
  }
}, true);
window.addEventListener('keyup', event => {
  if (event.key === 'Meta') {
    releaseAll();
  }
  if (event.code in drive || event.code === 'Space') {
    seize(event);
    release(event.code);
  }
}, true);
for (const name of ['blur', 'pagehide', 'contextmenu']) {
  window.addEventListener(name, releaseAll);
}
document.addEventListener('visibilitychange', releaseAll);

if (innerWidth < 900) {
  const timer = setInterval(() => {
    const collapse = document.querySelector('[aria-label="Collapse panel area"]');
    if (collapse) {
      clearInterval(timer);
      collapse.click();  // a narrow window starts without charts
    }
  }, 100);
}
