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
});
