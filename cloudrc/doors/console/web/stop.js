// SPDX-License-Identifier: Apache-2.0

// The path of the page, with a slash at its end: a proxy may serve the page in a folder.
const place = location.pathname.replace(/plain$/, '').replace(/\/?$/, '/');
const form = document.getElementById('stop');
const said = form.querySelector('output');
let clicks = 0;
let carriedOut = 0;  // number of the last click that the console has answered

// Ask for a stop until the console has it, or until it has a later one.
async function stop() {
  clicks += 1;
  const own = clicks;
  while (carriedOut < own) {
    try {
      const limit = AbortSignal.timeout(2000);
      const answer = await fetch(`${place}stop`, {method: 'POST', keepalive: true, signal: limit});
      if (answer.ok || answer.status === 403) {
        carriedOut = Math.max(carriedOut, own);
        said.textContent = answer.ok ? '' : await answer.text();
        return;
      }
      said.textContent = 'STOP is not carried out yet: asking again';
    } catch {
      said.textContent = 'The console does not answer: asking again';
    }
    await new Promise(resolve => setTimeout(resolve, 200));
  }
}

form.addEventListener('submit', event => {
  event.preventDefault();
  stop();
});
window.addEventListener('keydown', event => {
  // By place or by letter: the key at the place of X has another letter on some keyboards.
  const isX = event.code === 'KeyX' || event.key?.toLowerCase() === 'x';
  if (isX && event.shiftKey && !event.ctrlKey && !event.altKey && !event.metaKey) {
    event.preventDefault();
    event.stopImmediatePropagation();
    stop();
  }
}, true);
