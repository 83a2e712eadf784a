//! Plots over the time of training.

use nertca_vk::bench::PAPER_SECONDS;
use nertca_vk::error::{Error, Result};
use plotters::prelude::*;

/// Series of a plot.
pub struct Line {
    /// Name in the legend; a line with an empty name has no entry.
    pub name: String,
    /// Colour.
    pub colour: RGBColor,
    /// Seconds and values.
    pub points: Vec<(f64, f64)>,
    /// Whether the points are published ones, which are drawn as rings.
    pub published: bool,
}

/// Size of a plot, pixels.
const SIZE: (u32, u32) = (1060, 320);
/// Width of the curves; the legend is beside them.
const CURVES: u32 = 610;
/// Colour of the paper's time.
const PAPER: RGBColor = RGBColor(180, 40, 30);
/// Legend of the paper's time.
const PAPER_NAME: &str = "the paper: 37 minutes on an RTX A5000";

/// Draws the legend: a line and a name for each entry.
fn draw_legend<'a>(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    entries: impl Iterator<Item = (&'a str, RGBColor)>,
) -> Result<()> {
    const FIRST: i32 = 48;
    const STEP: i32 = 20;
    for ((name, colour), y) in entries.zip((FIRST..).step_by(STEP as usize)) {
        let line = PathElement::new([(0, y), (18, y)], colour.stroke_width(2));
        let text = Text::new(name.to_owned(), (24, y - 7), ("sans-serif", 14));
        area.draw(&line).and_then(|()| area.draw(&text)).map_err(|e| Error::Internal(format!("plot: {e}")))?;
    }
    Ok(())
}

/// Draws a plot over the time of training as SVG, with a logarithmic time axis that reaches the paper's 37 minutes; empty
/// without points.
///
/// # Errors
/// [`Error::Internal`] where the plot cannot be drawn.
pub fn plot(title: &str, lines: &[Line], log_y: bool) -> Result<String> {
    let fault = |e: &dyn std::fmt::Display| Error::Internal(format!("plot: {e}"));
    let all: Vec<(f64, f64)> = lines.iter().flat_map(|l| l.points.iter().copied()).filter(|p| p.0 > 0.0).collect();
    if all.is_empty() {
        return Ok(String::new());
    }
    let fold = |pick: fn(&(f64, f64)) -> f64, start: f64, f: fn(f64, f64) -> f64| all.iter().map(pick).fold(start, f);
    let first = fold(|p| p.0, f64::MAX, f64::min).max(1e-3);
    let last = fold(|p| p.0, 0.0, f64::max).max(PAPER_SECONDS * 1.3);
    let (mut low, mut high) = (fold(|p| p.1, f64::MAX, f64::min), fold(|p| p.1, f64::MIN, f64::max));
    if log_y {
        (low, high) = (low.max(1e-12).log10(), high.max(1e-12).log10());
    } else {
        low = low.min(0.0);
    }
    let room = 0.06 * (high - low).max(1e-6);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        let (curves, legend) = area.split_horizontally(CURVES);
        let mut chart = ChartBuilder::on(&curves)
            .margin(12)
            .x_label_area_size(38)
            .y_label_area_size(64)
            .caption(title, ("sans-serif", 18))
            .build_cartesian_2d(first.log10()..last.log10(), low..high + room)
            .map_err(|e| fault(&e))?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .x_desc("seconds of training")
            .x_label_formatter(&|x| match 10f64.powf(*x) {
                s if s < 10.0 => format!("{s:.1}"),
                s => format!("{s:.0}"),
            })
            .y_label_formatter(&|y| if log_y { format!("{:.1e}", 10f64.powf(*y)) } else { format!("{y:.2}") })
            .draw()
            .map_err(|e| fault(&e))?;
        let paper = [(PAPER_SECONDS.log10(), low), (PAPER_SECONDS.log10(), high + room)];
        chart.draw_series(std::iter::once(PathElement::new(paper, PAPER.stroke_width(1)))).map_err(|e| fault(&e))?;
        for line in lines.iter().filter(|l| !l.points.is_empty()) {
            let colour = line.colour;
            let at = |p: &(f64, f64)| (p.0.max(first).log10(), if log_y { p.1.max(1e-12).log10() } else { p.1 });
            let style = colour.stroke_width(2);
            chart.draw_series(LineSeries::new(line.points.iter().map(at), style)).map_err(|e| fault(&e))?;
            if line.points.len() < 40 {
                let (radius, style) = if line.published { (5, style) } else { (3, colour.filled()) };
                let dots = line.points.iter().map(|p| Circle::new(at(p), radius, style));
                chart.draw_series(dots).map_err(|e| fault(&e))?;
            }
        }
        let named = lines.iter().filter(|line| !line.name.is_empty() && !line.points.is_empty());
        let entries = named.map(|line| (line.name.as_str(), line.colour));
        draw_legend(&legend, entries.chain(std::iter::once((PAPER_NAME, PAPER))))?;
        area.present().map_err(|e| fault(&e))?;
    }
    Ok(svg)
}
