"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const key = "manip_il preferences " + data.pairs;
const keys = {ArrowLeft: "left", ArrowRight: "right", ArrowDown: "equal", s: "skip", S: "skip"};
const element = (name) => document.getElementById(name);
const who = element("who");
let answers = [];
let keeps = true;

function keep() {
  try {
    localStorage.setItem(key, JSON.stringify({who: who.value, answers}));
  } catch {
    keeps = false;
  }
}

function recall() {
  try {
    localStorage.setItem(key + " probe", "");  // not `key`: after a reload, its saved answers may not have loaded yet
    localStorage.removeItem(key + " probe");
  } catch {
    keeps = false;
  }
  try {
    const kept = JSON.parse(localStorage.getItem(key));
    const sound = (one, place) => one.pair === place && typeof one.answer === "string" && typeof one.when === "string";
    if (kept && kept.answers.length <= data.films.length && kept.answers.every(sound)) {
      answers = kept.answers;
      who.value = kept.who;
    }
  } catch {
    answers = [];
  }
}

function film(name, base64) {
  const video = element(name);
  video.src = "data:video/mp4;base64," + base64;
  video.play().catch(() => {});  // a browser that blocks autoplay shows the first picture
}

function show() {
  const count = answers.length, all = data.films.length, done = count === all;
  element("pair").hidden = element("skip").hidden = done;
  element("done").hidden = !done;
  element("undo").disabled = count === 0;
  element("bar").style.width = 100 * count / all + "%";
  element("bar").parentElement.setAttribute("aria-valuenow", count);
  element("count").textContent = done ? all + " pairs answered" : "Pair " + (count + 1) + " of " + all;
  element("note").hidden = keeps;
  if (!done) {
    film("left", data.films[count][0]);
    film("right", data.films[count][1]);
  }
}

function answer(choice) {
  if (answers.length < data.films.length) {
    answers.push({pair: answers.length, answer: choice, when: new Date().toISOString()});
    keep();
    show();
  }
}

function undo() {
  if (answers.length) {
    answers.pop();
    keep();
    show();
  }
}

function save() {
  const content = {format: data.format, version: data.version, pairs: data.pairs, who: who.value.trim(), answers};
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(content, null, 1) + "\n"], {type: "application/json"}));
  link.download = "preferences.json";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-answer]");
  if (button) answer(button.dataset.answer);
});
document.addEventListener("keydown", (event) => {
  if (event.target === who || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  if (event.key === "u" || event.key === "U") undo();
  else if (keys[event.key]) {
    event.preventDefault();  // arrow keys would scroll the page
    answer(keys[event.key]);
  }
});
element("undo").addEventListener("click", undo);
element("save").addEventListener("submit", (event) => {
  event.preventDefault();
  save();
});
who.addEventListener("input", keep);
recall();
show();
