/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Draw two recorded flights, and by how much each predictor is wrong. Lengths: m; times: s. */
"use strict";
const $ = (id) => document.getElementById(id);
const OLDEST = 0.8; // age with the last colour of the path
const LOW = [-3.1, -8.1], HIGH = [9.5, 5]; // corners of the view from above: x, y
const TALL = 2.4; // height of the view from the side
const NAMES = [["start", "left", 1.2, -0.1], ["board", "right", 9.3, -5.3]]; // in the view from above: x, y
const ERRORS = { 1: "≤ 1 mm", 10: "1 cm", 100: "10 cm", 1000: "1 m" };

/* Read the flights; differences become positions. */
async function read() {
  const packed = Uint8Array.from(atob($("data").textContent), (one) => one.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const all = await new Response(unpacked).json();
  const sums = (steps) => { let at = 0; return steps.map((step) => (at += step) / 100); };
  for (const flight of Object.values(all.flights))
    for (const track of ["robot", "cloud"]) flight[track] = flight[track].map(sums);
  return all;
}

function start(all) {
  const { rtt_ms: trips, predictors, links, rate_hz: rate } = all;
  const sides = ["A", "B"].map(makeSide);
  const [a, b] = sides;
  const flightOf = ({ link, predictor, trip }) => all.flights[`${link} ${predictor} ${trips[trip]}`];
  let now = 0, isPlaying = false, before = 0, paint;

  /* Put the figure and the choices of one flight on the page. */
  function makeSide(name) {
    const parts = document.querySelector("template").content.cloneNode(true);
    const [view, form] = [parts.querySelector(".view"), parts.querySelector(".choice")];
    const side = { name, view, form, pen: view.querySelector("canvas"), slider: form.querySelector("input") };
    for (const part of [view, form]) part.classList.add(name);
    view.querySelector("b").textContent = name;
    form.setAttribute("aria-label", `flight ${name}`);
    for (const [kind, names] of [["predictor", predictors], ["link", links]])
      for (const each of names) {
        const label = document.createElement("label"), input = document.createElement("input");
        Object.assign(input, { type: "radio", name: kind, value: each });
        label.append(input, ` ${each}`);
        form.querySelector(`.${kind}`).append(label);
      }
    side.slider.max = trips.length - 1;
    form.addEventListener("input", () => choose(side));
    $("bar").before(view, form);
    return side;
  }

  /* Take what a person has chosen for a side; A's network may be that of both. */
  function choose(side) {
    side.predictor = side.form.elements.predictor.value;
    side.link = side.form.elements.link.value;
    side.trip = +side.slider.value;
    if ($("same").checked) { b.link = a.link; b.trip = a.trip; }
    history.replaceState(null, "", `#${sides.map((one) => [one.link, one.predictor, trips[one.trip]]).join(";")}`);
    show();
  }

  /* Write the choices of both sides into the controls. */
  function show() {
    document.body.classList.toggle("same", $("same").checked);
    for (const side of sides) {
      const { form, slider } = side;
      form.elements.predictor.value = side.predictor;
      form.elements.link.value = side.link;
      slider.value = side.trip;
      form.querySelector(".network output").textContent = `${trips[side.trip]} ms`;
      slider.setAttribute("aria-valuetext", `${trips[side.trip]} ms`);
      side.flight = flightOf(side);
    }
    $("time").max = Math.max(a.flight.end, b.flight.end);
    now = Math.min(now, $("time").max);
    $("told").textContent = tell();
    $("command").textContent = a.flight.command;
    draw();
  }

  /* Say in sentences what the two flights show. */
  function tell() {
    const over = (side) => `${side.link} link, round trip ${trips[side.trip]} ms`;
    const isOne = a.link === b.link && a.trip === b.trip;
    const ends = sides.map((side) => {
      const { verdict, text, end } = side.flight, place = isOne ? "" : ` (${over(side)})`;
      const what = verdict === "success" ? `arrives after ${end} s` : `fails at ${end} s: ${text}`;
      return `${side.name} with ${side.predictor}${place} ${what}.\n`;
    });
    const limits = predictors.map((predictor) => {
      const fails = trips.findIndex((_, trip) => flightOf({ ...a, predictor, trip }).verdict !== "success");
      if (fails < 0) return `${predictor} at all round trips`;
      return `${predictor} ${fails ? `up to ${trips[fails - 1]} ms` : "at none"}`;
    });
    const text = `${isOne ? `Both: ${over(a)}.\n` : ""}${ends.join("")}Over ${isOne ? "this link" : "the link of A"}, ` +
      `${limits.join(", ").replace(" ", " arrives ")}.`;
    return text.replace(/ (ms|s)\b/g, "\u00a0$1");
  }

  function draw() {
    paint = colours();
    for (const side of sides) drawSide(side);
    drawLimit();
    $("time").value = now;
    $("clock").textContent = `${now.toFixed(1)} s`;
    $("play").textContent = isPlaying ? "Pause" : "Play";
  }

  /* Draw a flight up to now, from above and below that from the side, and say how it is. */
  function drawSide({ view, pen: canvas, flight }) {
    const { pen, width, height } = cleared(canvas);
    const scale = width / (HIGH[0] - LOW[0]), floor = height - 0.15 * scale;
    const last = Math.min(Math.floor(now * rate), flight.age.length - 1);
    const has_ended = now >= flight.end;
    const views = [["above", 1, (v) => (HIGH[1] - v) * scale], ["side", 2, (v) => floor - v * scale]];
    for (const [name, axis, up] of views) {
      const across = (x) => (x - LOW[0]) * scale;
      const at = (track, row) => [across(track[0][row]), up(track[axis][row])];
      pen.strokeStyle = paint.line;
      const lines = name === "above" ? [LOW[1], HIGH[1]] : [0, TALL];
      for (let x = Math.ceil(LOW[0]); x < HIGH[0]; x++) line(pen, [[across(x), up(lines[0])], [across(x), up(lines[1])]]);
      for (let v = Math.ceil(lines[0]); v < lines[1]; v++) line(pen, [[0, up(v)], [width, up(v)]]);
      for (const corners of all.outlines[name]) {
        line(pen, corners.map(([x, v]) => [across(x), up(v)]));
        pen.closePath();
        pen.fillStyle = paint.wall; pen.fill();
        pen.strokeStyle = paint.edge; pen.stroke();
      }
      pen.fillStyle = paint.grey;
      pen.fillText(`from ${name === "side" ? "the side" : name}`, 4, up(lines[1]) + 14);
      if (name === "above")
        for (const [text, end, x, y] of NAMES) {
          pen.textAlign = end;
          pen.fillText(text, across(x), up(y));
        }
      pen.textAlign = "left";
      const kind = (row) => flight.age[row] < 0 ? -1 : Math.round(20 * Math.min(flight.age[row] / 100 / OLDEST, 1));
      for (let row = 1, points = []; row <= last; row++) {
        points.push(at(flight.robot, row - 1));
        if (row < last && kind(row) === kind(row + 1)) continue;
        pen.strokeStyle = paint.ages[kind(row)] ?? paint.hold;
        pen.lineWidth = kind(row) < 0 ? 6 : 3;
        line(pen, [...points.splice(0), at(flight.robot, row)]);
      }
      const size = Math.max(5, 0.3 * scale);
      disc(pen, ...at(flight.robot, last), 0.7 * size);
      pen.fillStyle = paint.ink; pen.fill();
      disc(pen, ...at(flight.cloud, last), size);
      pen.setLineDash([4, 3]); pen.lineWidth = 2; pen.strokeStyle = paint.ghost; pen.stroke();
      pen.setLineDash([]); pen.lineWidth = 1;
      if (has_ended && flight.verdict !== "success") cross(pen, paint.fails, ...at(flight.robot, last), 10, 4);
    }
    const said = view.querySelector("output");
    said.textContent = has_ended ? ended(flight) : underWay(flight, last);
    said.className = !has_ended ? "" : flight.verdict === "success" ? "arrives" : "fails";
    canvas.setAttribute("aria-label", `The flown path from above and from the side: ${said.textContent}`);
  }

  const ended = ({ verdict, text, end }) =>
    verdict === "success" ? `SUCCESS after ${end} s: at the board` : `FAILURE at ${end} s: ${text}`;

  function underWay(flight, row) {
    const off = Math.hypot(...[0, 1, 2].map((axis) => flight.robot[axis][row] - flight.cloud[axis][row]));
    if (flight.age[row] >= 0)
      return `acts on what was ${10 * flight.age[row]} ms ago; the cloud is wrong by ${Math.round(100 * off)} cm`;
    return flight.age.slice(0, row).some((age) => age >= 0) ? "HOLD: no fresh command" : "waits for the first command";
  }

  /* Draw the error of each predictor over the round trip, and where A and B are. */
  function drawLimit() {
    const { pen, width, height } = cleared($("limit").querySelector("canvas"));
    const x = (trip) => 56 + (width - 170) * trips[trip] / trips.at(-1);
    const y = (mm) => height - 38 - (height - 50) * Math.log10(Math.max(mm, 1)) / Math.log10(2000);
    pen.fillStyle = paint.grey; pen.strokeStyle = paint.line;
    for (const [mm, text] of Object.entries(ERRORS)) {
      line(pen, [[56, y(mm)], [x(trips.length - 1), y(mm)]]);
      pen.fillText(text, 4, y(mm) + 4);
    }
    let free = 0;
    for (const [trip, ms] of trips.entries()) {
      if (x(trip) < free) continue;
      pen.fillText(ms, x(trip) - 10, height - 20);
      free = x(trip) + 30;
    }
    pen.fillText("round trip (ms)", x(0), height - 4);
    let above = 0;
    const height_of = (predictor) => y(flightOf({ ...a, predictor, trip: trips.length - 1 }).error_mm);
    for (const predictor of [...predictors].sort((one, other) => height_of(one) - height_of(other))) {
      const row = trips.map((_, trip) => [flightOf({ ...a, predictor, trip }), trip]);
      const points = row.map(([flight, trip]) => [x(trip), y(flight.error_mm)]);
      pen.strokeStyle = pen.fillStyle = sides.some((side) => side.predictor === predictor) ? paint.ink : paint.grey;
      const fails = row.findIndex(([flight]) => flight.verdict !== "success");
      pen.lineWidth = 2;
      line(pen, fails < 0 ? points : points.slice(0, fails));
      pen.lineWidth = 1;
      pen.setLineDash([2, 4]);
      if (fails >= 0) line(pen, points.slice(Math.max(fails - 1, 0)));
      pen.setLineDash([]);
      above = Math.max(above + 15, points.at(-1)[1] + 4);
      pen.fillText(predictor, points.at(-1)[0] + 9, above);
      row.forEach(([flight], trip) => {
        if (flight.verdict !== "success") return cross(pen, paint.fails, ...points[trip], 4, 2);
        disc(pen, ...points[trip], 3);
        pen.fillStyle = paint.paper; pen.fill(); pen.stroke();
      });
    }
    for (const { name, flight, trip } of sides) {
      const place = [x(trip), y(flight.error_mm)];
      disc(pen, ...place, 9);
      pen.fillStyle = paint.accent; pen.fill();
      pen.fillStyle = paint.paper; pen.fillText(name, place[0] - 4, place[1] + 4);
    }
  }

  function tick(time) {
    if (!isPlaying) return;
    now = Math.min(now + Math.min(time - before, 100) * $("speed").value / 1000, $("time").max);
    before = time;
    isPlaying = now < $("time").max;
    draw();
    requestAnimationFrame(tick);
  }

  function play(wanted = !isPlaying) {
    isPlaying = wanted;
    if (wanted && now >= $("time").max) now = 0;
    before = performance.now();
    requestAnimationFrame(tick);
    draw();
  }

  const seek = (time) => { now = Math.max(0, Math.min(time, $("time").max)); draw(); };
  const asked = decodeURI(location.hash.slice(1)).split(";").map((one) => one.split(","));
  const firsts = [[links[0], "last_sample", 300], [links[0], "model_based", 300]];
  const isKnown = asked.length === 2 && asked.every(([link, name, ms]) => all.flights[`${link} ${name} ${ms}`]);
  (isKnown ? asked : firsts).forEach(([link, predictor, ms], number) =>
    Object.assign(sides[number], { link, predictor, trip: Math.max(trips.indexOf(+ms), 0) }));
  $("same").checked = a.link === b.link && a.trip === b.trip;
  $("same").addEventListener("change", () => choose(b));
  $("time").addEventListener("input", () => seek(+$("time").value));
  $("play").addEventListener("click", () => play());
  addEventListener("keydown", (event) => {
    const kind = event.target.type ?? event.target.tagName;
    if (event.key === " " && !/button|checkbox|radio|select|summary|^A$/i.test(kind)) { event.preventDefault(); play(); }
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step && event.target === document.body) seek(now + step);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  show();
  new ResizeObserver(draw).observe(document.querySelector("main"));
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) seek(+$("time").max);
  else play(true);
  performance.mark("drawn");
  document.body.dataset.ready = "yes";
}

/* Read the colours of the style, which are others in the dark; `ages` has one per 5 % of the oldest age. */
function colours() {
  const style = getComputedStyle(document.documentElement);
  const named = ["paper", "ink", "grey", "line", "wall", "edge", "young", "old", "hold", "ghost", "accent", "fails"];
  const found = Object.fromEntries(named.map((name) => [name, style.getPropertyValue(`--${name}`)]));
  const ages = [...Array(21).keys()].map((part) => `color-mix(in oklab, ${found.old} ${5 * part}%, ${found.young})`);
  return { ...found, ages };
}

/* Give a canvas the pixels of the screen; return its empty pen, and its size in pixels of CSS. */
function cleared(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas, dots = devicePixelRatio;
  canvas.width = width * dots;
  canvas.height = height * dots;
  const pen = canvas.getContext("2d");
  pen.scale(dots, dots);
  pen.font = "12px system-ui, sans-serif";
  pen.lineCap = pen.lineJoin = "round";
  return { pen, width, height };
}

function line(pen, points) {
  pen.beginPath();
  for (const point of points) pen.lineTo(...point);
  pen.stroke();
}

function disc(pen, x, y, size) {
  pen.beginPath();
  pen.arc(x, y, size, 0, 2 * Math.PI);
}

function cross(pen, colour, x, y, size, width) {
  const before = [pen.strokeStyle, pen.lineWidth];
  [pen.strokeStyle, pen.lineWidth] = [colour, width];
  line(pen, [[x - size, y - size], [x + size, y + size]]);
  line(pen, [[x - size, y + size], [x + size, y - size]]);
  [pen.strokeStyle, pen.lineWidth] = before;
}

read().then(start);
