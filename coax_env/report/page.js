// Unpacks plotly and draws the page's figures when they come near the screen, in the reader's colours.
const dark = matchMedia('(prefers-color-scheme: dark)');
const PAPER_WIDTH = 680, PAPER_SHARE = 0.75; // px between the margins of a printed page; of a height
let printing = false;
const theme = () => THEMES[dark.matches && !printing ? 'dark' : 'light'];
const restyled = []; // what else is to be drawn again when the colours change

const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const packed = document.getElementById('plotly');
const library = packed && unpack(packed.textContent);
if (library) library.catch(() => document.querySelectorAll('.plot').forEach(
  plot => { plot.textContent = 'This browser is too old to draw the figures.'; }));

async function unpack(text) {
  const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream('gzip'));
  const script = document.createElement('script');
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

function shape(plot) {
  const height = Number(plot.dataset.height);
  return printing
    ? {width: PAPER_WIDTH, height: PAPER_SHARE * height, autosize: false}
    : {width: null, height, autosize: true};
}

function draw(plot) {
  if (plot.dataset.drawn || plot.closest('[hidden]') || plot.closest('details:not([open])')) return;
  plot.dataset.drawn = '1';
  const content = JSON.parse(plot.nextElementSibling.textContent);
  plot.dataset.height = content.layout.height;
  const layout = Object.assign({}, content.layout, {template: theme()}, printing ? shape(plot) : {});
  Plotly.newPlot(plot, content.data, layout, {responsive: true, displayModeBar: false});
}
const drawIn = part => library && library.then(() => part.querySelectorAll('.plot').forEach(draw));

function restyle() {
  document.querySelectorAll('.plot[data-drawn]').forEach(
    plot => Plotly.relayout(plot, Object.assign({template: theme()}, shape(plot))));
  restyled.forEach(again => again());
}
dark.addEventListener('change', restyle);
const folded = () => document.querySelectorAll('details.numbers');
addEventListener('beforeprint', () => {
  printing = true;
  folded().forEach(part => { part.dataset.was = part.open; part.open = true; });
  if (window.Plotly) document.querySelectorAll('.plot').forEach(draw);
  restyle();
});
addEventListener('afterprint', () => {
  printing = false;
  folded().forEach(part => { part.open = part.dataset.was === 'true'; });
  restyle();
});

document.querySelectorAll('.chooser').forEach(chooser => {
  const lists = [...chooser.querySelectorAll('select')];
  const choices = [...chooser.querySelectorAll('.choice')];
  const show = () => {
    const key = lists.map(list => list.value).join('|');
    choices.forEach(choice => { choice.hidden = choice.dataset.key !== key; });
    chooser.querySelector('.none').hidden = choices.some(choice => !choice.hidden);
    drawIn(chooser);
  };
  lists.forEach(list => list.addEventListener('change', show));
});
document.querySelectorAll('details').forEach(d => d.addEventListener('toggle', () => drawIn(d)));

const near = new IntersectionObserver(seen => seen.forEach(one => {
  if (one.isIntersecting) { library.then(() => draw(one.target)); near.unobserve(one.target); }
}), {rootMargin: '1200px'});
document.querySelectorAll('.plot').forEach(plot => near.observe(plot));
