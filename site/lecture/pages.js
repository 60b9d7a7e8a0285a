// From a notebook's long slides, one per heading, to pages that fit a screen.
//
// nbconvert makes a slide of all that stands between two slide marks, often several screens of it. Here it is
// taken apart into blocks (a paragraph, a table, a cell's code, an output) which fill page after page. Within
// a page, each cell's code and each of its outputs waits for a key: there is time to predict. A block that is
// taller or wider than a page is made smaller; a table, a little, and then it is cut between its rows.

const WIDTH = 1280;
const HEIGHT = 720;
const ROOM = HEIGHT - 40;

window.MathJax = {
  tex: { inlineMath: [["$", "$"], ["\\(", "\\)"]], displayMath: [["$$", "$$"], ["\\[", "\\]"]], tags: "ams" },
  svg: { fontCache: "global" },
  options: { enableMenu: false },
  startup: { typeset: false },
};

const make = (tag, classes, ...children) => {
  const element = document.createElement(tag);
  element.className = classes;
  element.append(...children);
  return element;
};

// A slide's blocks in order. `step` counts what is shown together; `fresh` begins a page.
function blocksOf(slide) {
  const blocks = [];
  let step = 0;
  for (const cell of slide.querySelectorAll(".jp-Cell")) {
    const markdown = cell.querySelector(".jp-RenderedMarkdown");
    if (markdown && cell.classList.contains("jp-MarkdownCell")) {
      step += 1;
      if (markdown.classList.contains("celltag_answer")) {
        for (const node of answerOf(markdown)) blocks.push({ node, step, answer: true, fresh: node.tagName === "H3" });
        continue;
      }
      for (const node of [...markdown.children]) {
        const heading = /^H[123]$/.test(node.tagName);
        blocks.push({ node, step, heading, fresh: heading });
      }
      continue;
    }
    const solution = ["hide-cell", "hide-input"].some((tag) => cell.classList.contains(`celltag_${tag}`));
    const code = cell.querySelector(".jp-InputArea-editor");
    if (code) blocks.push({ node: make("div", "code", ...code.childNodes), step: ++step, fresh: solution });
    for (const output of cell.querySelectorAll(".jp-OutputArea-child")) {
      const text = output.querySelector(".jp-RenderedMarkdown");  // a table that code made
      const parts = text ? [...text.children] : [make("div", "output", ...output.childNodes)];
      step += 1;
      for (const node of parts) blocks.push({ node, step });
    }
  }
  blocks.forEach((block, n) => { block.fresh ||= n === 0 || (blocks[n - 1].answer && !block.answer); });
  return blocks;
}

// What is folded elsewhere, after the word to click on as a heading: an answer begins a page of its own.
function answerOf(markdown) {
  const details = markdown.querySelector("details");
  const [summary, ...rest] = details.children;
  return [make("h3", "", summary.textContent), ...rest];
}

// The rows of a table that are too many for the page go into a table of their own, under the same head.
function splitTable(page, table) {
  const rows = [...table.querySelectorAll("tbody tr")];
  const rest = table.cloneNode(true);
  const body = rest.querySelector("tbody");
  body.replaceChildren();
  while (page.scrollHeight > ROOM && rows.length > 1) body.prepend(rows.pop().parentNode.lastElementChild);
  return body.children.length ? rest : null;
}

function shrink(page, node, least) {
  for (let zoom = 1; page.scrollHeight > ROOM && zoom >= least; zoom -= 0.02) node.style.zoom = zoom;
}

function narrow(page, node) {
  const wide = node.querySelector('mjx-container[display="true"]') || node;
  for (let zoom = 1; page.scrollWidth > WIDTH && zoom >= 0.3; zoom -= 0.02) wide.style.zoom = zoom;
}

// Fills pages with blocks; returns them as a list of slides, each a list of pages.
function paginate(blocks, stage) {
  const slides = [];
  let page = null, title = "", used = [];
  const turn = (newSlide) => {
    page = make("section", "");
    used = [];
    stage.replaceChildren(page);
    if (newSlide || !slides.length) slides.push([]);
    else if (title) page.append(make("p", "running", title));
    slides.at(-1).push(page);
  };
  const put = (block) => {
    page.append(block.node);
    used.push(block);
    if (used[0].step !== block.step) {
      block.node.classList.add("fragment");
      block.node.dataset.fragmentIndex = block.step;
    }
  };
  const queue = [...blocks];
  while (queue.length) {
    const block = queue.shift();
    if (!page || block.heading) turn(true);
    else if (block.fresh) turn(false);
    if (block.heading) title = block.node.textContent;
    put(block);
    narrow(page, block.node);
    if (page.scrollHeight <= ROOM) continue;
    const table = block.node.tagName === "TABLE";
    const enoughAbove = used.some((other) => other !== block && !other.heading);
    if (enoughAbove && !(table && block.node.offsetTop < ROOM / 2)) {
      block.node.classList.remove("fragment");
      delete block.node.dataset.fragmentIndex;
      turn(false);
      used = [];
      queue.unshift({ ...block, heading: false, fresh: false });
    } else if (table) {
      shrink(page, block.node, 0.8);
      const rest = splitTable(page, block.node);
      if (rest) {
        turn(false);
        queue.unshift({ ...block, node: rest });
      }
    }
    shrink(page, block.node, 0.3);
  }
  return slides;
}

async function present() {
  await MathJax.startup.promise;
  await MathJax.typesetPromise();
  await document.fonts.ready;
  await Promise.all([...document.images].map((image) => image.decode().catch(() => {})));

  const deck = document.querySelector(".reveal .slides");
  const blocks = [...deck.children].flatMap(blocksOf);
  const stage = make("section", "stage");
  deck.replaceChildren(stage);
  deck.style.width = `${WIDTH}px`;
  const slides = paginate(blocks, stage);
  deck.style.width = "";
  deck.replaceChildren(...slides.map((pages) => make("section", "", ...pages)));

  await Reveal.initialize({
    width: WIDTH, height: HEIGHT, margin: 0.02, center: false, hash: true, navigationMode: "linear",
    transition: "none", slideNumber: "c/t", pdfSeparateFragments: false,
  });
  document.body.dataset.pages = Reveal.getTotalSlides();
}

window.addEventListener("load", present);
