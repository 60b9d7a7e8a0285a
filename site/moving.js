// A control without a kernel: a range input chooses among pictures that were made when the page was built.
document.addEventListener("input", ({ target }) => {
  const control = target.closest(".moving");
  if (!control) return;
  const { sliders, pictures, texts } = JSON.parse(control.querySelector("script").textContent);
  let place = 0;
  control.querySelectorAll("input").forEach((input, n) => {
    const { labels } = sliders[n];
    const label = labels[input.valueAsNumber];
    place = place * labels.length + input.valueAsNumber;
    input.setAttribute("aria-valuetext", label);
    input.nextElementSibling.textContent = label;
  });
  const image = control.querySelector("img");
  image.src = `${control.dataset.address}/${pictures[place]}`;
  image.alt = texts[place];
  const words = control.querySelector(".words");
  if (words) words.textContent = texts[place];
});

// A control with a button moves its last slider by itself, to the end or until the button is pressed. It starts
// alone where the visitor has not asked for less motion. A hand on that slider stops it.
document.addEventListener("DOMContentLoaded", () => {
  for (const button of document.querySelectorAll(".moving button.play")) {
    const control = button.closest(".moving");
    const step = [...control.querySelectorAll("input")].at(-1);
    const { pictures } = JSON.parse(control.querySelector("script").textContent);
    for (const picture of pictures) new Image().src = `${control.dataset.address}/${picture}`;
    let timer = 0;
    const stop = () => {
      clearInterval(timer);
      timer = 0;
      button.textContent = "Play";
    };
    const show = (value) => {
      step.value = value;
      step.dispatchEvent(new Event("input", { bubbles: true }));
    };
    const play = () => {
      if (step.value === step.max) show(0);
      button.textContent = "Pause";
      timer = setInterval(() => {
        show(step.valueAsNumber + 1);
        if (step.value === step.max) stop();
      }, 150);
    };
    button.addEventListener("click", () => (timer ? stop() : play()));
    step.addEventListener("input", (event) => event.isTrusted && timer && stop());
    if (matchMedia("(prefers-reduced-motion: no-preference)").matches) play();
  }
});
