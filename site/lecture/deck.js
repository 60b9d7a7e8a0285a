// Shows a lecture, whose slides are complete when the page is loaded. S opens the speaker's window, with the notes
// and a clock. N shows the notes beside the slide. With ?print-pdf in the address, each slide's notes follow it.
const WIDTH = 1280;
const HEIGHT = 720;

window.MathJax = {
  tex: { inlineMath: [["$", "$"], ["\\(", "\\)"]], displayMath: [["$$", "$$"], ["\\[", "\\]"]], tags: "none" },
  svg: { fontCache: "global" },
  options: { enableMenu: false },
  startup: { typeset: false },
};

// Makes the picture smaller until the slide fits the screen, and a formula until it is no wider than the slide.
function fit(slide) {
  const picture = slide.querySelector(".shown img");
  for (let size = picture?.clientHeight; picture && slide.scrollHeight > HEIGHT - 24 && size >= 200; size -= 10) {
    picture.style.maxHeight = `${size}px`;
  }
  const formula = slide.querySelector('.shown mjx-container[display="true"]');
  for (let zoom = 1.3; formula && zoom >= 0.5; zoom -= 0.02) {
    formula.style.zoom = zoom;
    const { right } = formula.querySelector("svg").getBoundingClientRect();
    if (right <= slide.getBoundingClientRect().right - 20) break;
  }
}

window.addEventListener("load", async () => {
  await MathJax.startup.promise;
  document.body.classList.add("measuring"); // all slides are laid out, one below the other
  await MathJax.typesetPromise();
  await Promise.all([...document.images].map((image) => image.decode().catch(() => {})));
  document.querySelectorAll(".slides > section").forEach(fit);
  document.body.classList.remove("measuring");
  const printed = /print-pdf/.test(window.location.search);
  await Reveal.initialize({
    width: WIDTH, height: HEIGHT, margin: 0.02, center: false, hash: true, transition: "none", controls: false,
    slideNumber: "c/t", showNotes: printed ? "separate-page" : false, plugins: [RevealNotes],
  });
  Reveal.addKeyBinding({ keyCode: 78, key: "N", description: "Show the notes" }, () => {
    Reveal.configure({ showNotes: !Reveal.getConfig().showNotes });
    Reveal.layout(); // the slide makes room for them
  });
  document.body.dataset.pages = Reveal.getTotalSlides();
});
