for (const slider of document.querySelectorAll(".compare input")) {
  slider.addEventListener("input", () => slider.parentNode.style.setProperty("--split", slider.value + "%"));
}
for (const film of document.querySelectorAll(".film")) {
  const frames = [...film.querySelectorAll("img")];
  const [button, slider] = film.nextElementSibling.children;
  let shown = 0;
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  const show = (i) => {
    // Frame 0 stays below, so that nothing flickers while a picture decodes.
    frames[shown].classList.remove("on");
    shown = i;
    frames[shown].classList.add("on");
    slider.value = shown;
  };
  const mark = () => { button.textContent = playing ? "❚❚" : "▶"; };
  button.addEventListener("click", () => { playing = !playing; mark(); });
  slider.addEventListener("input", () => { playing = false; mark(); show(Number(slider.value)); });
  setInterval(() => { if (playing) show((shown + 1) % frames.length); }, 1000 / 15);
  mark();
}
