// SPDX-License-Identifier: Apache-2.0

const acts = document.getElementById('acts');
const answered = document.getElementById('answer');

acts.addEventListener('submit', async event => {
  event.preventDefault();
  const name = event.submitter.getAttribute('formaction');
  try {
    const answer = await fetch(place + name, {method: 'POST', signal: AbortSignal.timeout(12000)});
    answered.textContent = await answer.text();
  } catch {
    answered.textContent = `${name}: the console does not answer`;
  }
});

// Show the present state once a second.
async function show() {
  const state = document.getElementById('state');
  try {
    const answer = await fetch(`${place}state`, {signal: AbortSignal.timeout(5000)});
    const present = await answer.json();
    state.textContent = present.lines.join('\n');
    acts.hidden = !present.acts.length;
  } catch {
    state.textContent = 'The console does not answer';
  }
  setTimeout(show, 1000);
}

show();
