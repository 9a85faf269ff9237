//! Learning curves of several systems in one picture: the mean over the runs of each, with a band, and marks at given values.

use super::axis::{Axis, short_count, ticks};
use super::{AXIS, FOOTER, HEADER, LARGE, LINE, MARGIN, Svg, TITLE, WIDTH, escape, frame, style};
use magex_core::error::FieldError;
use magex_core::metrics_table::share;
use std::fmt::Write as _;

/// A system's curve over joint environment steps.
#[derive(Debug, Clone, PartialEq)]
pub struct SystemCurve {
    /// Name in the legend. Equal names have one colour in all panels.
    pub name: String,
    /// Points with rising steps.
    pub points: Vec<Band>,
    /// A value to compare with, marked at the right end.
    pub mark: Option<f64>,
}

/// A point of a curve with the band around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Joint environment steps.
    pub steps: f64,
    /// Mean over the runs.
    pub mean: f64,
    /// Lower edge of the band.
    pub low: f64,
    /// Upper edge of the band.
    pub high: f64,
}

/// One plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What is plotted: a share between 0 and 1.
    pub title: String,
    /// At least one.
    pub curves: Vec<SystemCurve>,
}

/// Where the longest curve is more than this many times as long as the shortest, the horizontal axis is logarithmic.
const LOG_FROM: f64 = 20.0;
/// Colours on white and on black. The eleventh system has the first colour again, with a dashed line.
const COLOURS: [(&str, &str, &str); 10] = [
    ("s0", "#2f6fde", "#6ea3ff"),
    ("s1", "#c2570c", "#f2a057"),
    ("s2", "#8b4fd8", "#c9a2ff"),
    ("s3", "#0b7d84", "#4fc9cf"),
    ("s4", "#b8327a", "#f08cc0"),
    ("s5", "#3f7d20", "#8fd16a"),
    ("s6", "#8a5a2b", "#d3a878"),
    ("s7", "#5d6879", "#9aa4b6"),
    ("s8", "#c62f2f", "#ff8a80"),
    ("s9", "#7a7a10", "#d6d45a"),
];
const BAND_STYLE: &str = "polygon{fill:currentColor;opacity:.18}.mark{opacity:1}.dashed{stroke-dasharray:7 4}\n";
/// Entries of a legend beside each other.
const COLUMNS: usize = 3;
/// Between the end of the curves and the edge, for the marks.
const RIGHT: f64 = 14.0;

/// The picture of at least one panel as SVG text. `note` is the last line: what mean, band and marks are.
///
/// # Errors
/// No panel has a curve.
pub fn systems_svg(title: &str, subtitle: &str, panels: &[Panel], note: &str) -> Result<String, FieldError> {
    let mut names: Vec<&str> = Vec::new();
    for curve in panels.iter().flat_map(|panel| &panel.curves) {
        if !names.contains(&curve.name.as_str()) {
            names.push(&curve.name);
        }
    }
    if names.is_empty() {
        return Err(FieldError::new("curves", "there are none to draw"));
    }
    let mut svg = Svg { body: String::new(), last: 1.0 };
    svg.text([MARGIN, 34.0], "start", "ink name", title);
    svg.text([MARGIN, 54.0], "start", "soft", subtitle);
    let mut top = HEADER;
    for panel in panels.iter().filter(|panel| !panel.curves.is_empty()) {
        top = draw(&mut svg, panel, &names, top);
    }
    let marked = panels.iter().flat_map(|panel| &panel.curves).any(|curve| curve.mark.is_some());
    for line in std::iter::once(note).chain(marked.then_some("A diamond: the value that the paper reports.")) {
        svg.text([MARGIN, top + 8.0], "start", "soft", line);
        top += LINE;
    }
    let height = top + FOOTER - LINE;
    let style = style(frame().into_iter().chain(COLOURS).collect(), BAND_STYLE);
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" \
         role=\"img\">\n<title>Learning curves: {}</title>\n<style>\n{style}</style>\n\
         <rect class=\"page\" width=\"100%\" height=\"100%\"/>\n{}</svg>\n",
        escape(title),
        svg.body
    ))
}

/// Draws a panel at `head`; where the next one begins.
fn draw(svg: &mut Svg, panel: &Panel, names: &[&str], head: f64) -> f64 {
    let rows = panel.curves.len().div_ceil(COLUMNS);
    let top = head + TITLE + LINE * (rows as f64 - 1.0);
    let bottom = top + LARGE;
    let (start, right) = (MARGIN + 52.0, WIDTH - MARGIN - RIGHT);
    let y = Axis { from: 0.0, to: 1.0, start: bottom, end: top, log: false };
    for tick in y.ticks(6) {
        svg.line([start, y.at(tick)], [right, y.at(tick)]);
        svg.text([start - 8.0, y.at(tick) + 4.0], "end", "soft label", &format!("{:.0} %", 100.0 * tick));
    }
    let x = horizontal(panel, start, right);
    let steps = if x.log { x.ticks(8) } else { ticks(0.0, x.to, 10) };
    for tick in steps {
        svg.line([x.at(tick), top], [x.at(tick), bottom]);
        svg.text([x.at(tick), bottom + 17.0], "middle", "soft label", &short_count(tick));
    }
    let log = if x.log { ", over joint environment steps, log scale" } else { ", over joint environment steps" };
    svg.text([MARGIN, head + 12.0], "start", "ink title", &format!("{}{log}", panel.title));
    let width = (WIDTH - 2.0 * MARGIN) / COLUMNS as f64;
    for (k, curve) in panel.curves.iter().enumerate() {
        let (class, dashed) = look(names, &curve.name);
        let last = curve.points.last().map_or("no data yet".to_owned(), |point| share(point.mean));
        let place = [MARGIN + width * (k % COLUMNS) as f64, head + 31.0 + LINE * (k / COLUMNS) as f64];
        let dash = if dashed { "╌" } else { "━" };
        svg.text(place, "start", &format!("label {class}"), &format!("{dash} {} {last}", curve.name));
        let at = |steps: f64, value: f64| format!("{:.1},{:.1}", x.at(steps.clamp(x.from, x.to)), y.at(value));
        let upper = curve.points.iter().map(|p| at(p.steps, p.high));
        let lower = curve.points.iter().rev().map(|p| at(p.steps, p.low));
        if curve.points.iter().any(|p| p.high > p.low) {
            polygon(svg, class, &upper.chain(lower).collect::<Vec<_>>());
        }
        let line: Vec<String> = curve.points.iter().map(|p| at(p.steps, p.mean)).collect();
        let dashed = if dashed { " dashed" } else { "" };
        // Writing to a string cannot fail.
        let _ = writeln!(
            svg.body,
            "<polyline class=\"{class}{dashed}\" points=\"{}\" stroke-width=\"1.8\"/>",
            line.join(" ")
        );
        if let Some(mark) = curve.mark {
            let (x, y) = (right + RIGHT / 2.0, y.at(mark));
            let corners = [[x - 5.0, y], [x, y - 5.0], [x + 5.0, y], [x, y + 5.0]];
            let corners: Vec<String> = corners.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
            polygon(svg, &format!("{class} mark"), &corners);
        }
    }
    bottom + AXIS
}

/// The axis of the steps: from 0, or from the first step with a point where curves differ much in length.
fn horizontal(panel: &Panel, start: f64, end: f64) -> Axis {
    let ends: Vec<f64> = panel.curves.iter().filter_map(|curve| Some(curve.points.last()?.steps)).collect();
    let longest = ends.iter().copied().fold(1.0, f64::max);
    let shortest = ends.iter().copied().filter(|&steps| steps > 0.0).fold(longest, f64::min);
    let steps = panel.curves.iter().flat_map(|curve| &curve.points).map(|point| point.steps);
    let first = steps.filter(|&steps| steps > 0.0).fold(longest, f64::min);
    let log = longest > LOG_FROM * shortest && first < longest;
    Axis { from: if log { first } else { 0.0 }, to: longest, start, end, log }
}

/// The class of a system, and whether its line is dashed.
fn look(names: &[&str], name: &str) -> (&'static str, bool) {
    let place = names.iter().position(|one| *one == name).unwrap_or_default();
    (COLOURS[place % COLOURS.len()].0, place >= COLOURS.len())
}

fn polygon(svg: &mut Svg, class: &str, corners: &[String]) {
    // Writing to a string cannot fail.
    let _ = writeln!(svg.body, "<polygon class=\"{class}\" points=\"{}\"/>", corners.join(" "));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(name: &str, end: f64, mark: Option<f64>) -> SystemCurve {
        let point = |k: u32| {
            let mean = f64::from(k) / 10.0;
            Band { steps: end * mean, mean, low: mean * 0.9, high: (mean * 1.1).min(1.0) }
        };
        SystemCurve { name: name.into(), points: (0..=10).map(point).collect(), mark }
    }

    fn panel(curves: Vec<SystemCurve>) -> Panel {
        Panel { title: "N = 5, success rate".into(), curves }
    }

    #[test]
    fn a_system_has_one_colour_in_all_panels_and_its_mark() {
        let panels =
            [panel(vec![curve("A<1>", 1e5, Some(0.82))]), panel(vec![curve("B", 1e5, None), curve("A<1>", 9e4, None)])];
        let svg = systems_svg("spread", "", &panels, "note").unwrap();
        assert_eq!(svg.matches("━ A&lt;1&gt; 1.0000").count(), 2);
        assert_eq!(svg.matches("<polyline class=\"s0\"").count(), 2);
        assert_eq!(svg.matches("<polyline class=\"s1\"").count(), 1);
        assert_eq!((svg.matches("<polygon").count(), svg.matches(" mark\"").count()), (4, 1));
        assert!(svg.contains("A diamond") && !svg.contains("NaN") && !svg.contains("log scale"));
        let after = svg.split("</style>").nth(1).unwrap();
        assert!(!after.contains('#') && !after.contains("fill="), "colours stand in the style block");
    }

    #[test]
    fn curves_of_different_lengths_share_a_logarithmic_axis() {
        let svg = systems_svg("", "", &[panel(vec![curve("A", 5e3, None), curve("B", 3e6, None)])], "").unwrap();
        assert!(svg.contains("log scale") && svg.contains(">1M<") && !svg.contains("inf") && !svg.contains("NaN"));
    }

    #[test]
    fn more_systems_than_colours_are_told_apart_and_none_is_refused() {
        let many = (0..12).map(|k| curve(&format!("S{k}"), 1e4, None)).collect();
        let svg = systems_svg("", "", &[panel(many)], "").unwrap();
        assert_eq!(svg.matches("s0 dashed\"").count(), 1);
        assert!(systems_svg("", "", &[panel(vec![])], "").is_err());
    }
}
