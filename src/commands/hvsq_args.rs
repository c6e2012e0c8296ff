//! What commands that measure HVSQ take, and the measuring.

use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use clap::Args;
use gazesplat_core::color::from_u8;
use gazesplat_core::display::MAX_FOV_DEG;
use gazesplat_core::{Display, Gaze, ImageF32, PixelGrid, RgbImage8, io};
use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::{GazePooling, Pooling, level_pooling_px};
use gazesplat_fovea::hvsq::{Distance, HvsqReference, ImageView};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::unmasked;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Eccentricities at which quality levels 1, 2 and 3 begin, degrees (RTGS Sec. 5.1).
const REGION_EDGES_DEG: [f64; 3] = [18.0, 27.0, 33.0];

/// Flags of HVSQ.
#[derive(Debug, Clone, Default, Args)]
pub struct HvsqArgs {
    /// Measure HVSQ over square pools of these sizes in pixels, at least 1 each [without a list: 1,3,7,12]
    #[arg(long, value_name = "SIZES", num_args = 0..=1, default_missing_value = "1,3,7,12", value_delimiter = ',',
        value_parser = parse_size)]
    pub hvsq: Option<Vec<f64>>,
    /// Measure HVSQ for an eye that looks at this point: 0.5,0.5 is the centre, 0,0 the upper left corner
    #[arg(long, value_name = "X,Y", value_parser = parse_gaze, allow_hyphen_values = true)]
    pub gaze: Option<Gaze>,
    /// Horizontal field of view the picture is seen under [default: 90]
    #[arg(long, value_name = "DEG", value_parser = parse_display)]
    pub display_fov: Option<Display>,
    /// Measure each region by eccentricity too: up to 18, 27, 33 degrees from the gaze, and beyond
    #[arg(long)]
    pub hvsq_regions: bool,
    /// Write where the difference is as a PNG, the brighter the more: of the gaze where there is one, else of the
    /// last size
    #[arg(long, value_name = "FILE")]
    pub hvsq_map: Option<PathBuf>,
}

fn parse_size(text: &str) -> std::result::Result<f64, String> {
    text.trim().parse().map_err(|_| {
        "expected sizes in pixels such as 1,3,7,12; what is no size stands before `--hvsq` or behind another option"
            .to_owned()
    })
}

fn parse_gaze(text: &str) -> std::result::Result<Gaze, String> {
    let number = |s: &str| s.trim().parse::<f64>().ok();
    text.split_once(',')
        .and_then(|(x, y)| Gaze::new(number(x)?, number(y)?).ok())
        .ok_or_else(|| "expected two finite numbers such as 0.5,0.5".to_owned())
}

fn parse_display(text: &str) -> std::result::Result<Display, String> {
    let display = text.parse().ok().and_then(|degrees| Display::from_fov_deg(degrees).ok());
    display.ok_or_else(|| format!("expected degrees above 0 and up to {MAX_FOV_DEG}"))
}

impl HvsqArgs {
    /// What is to be measured; `None` when nothing was asked for.
    ///
    /// # Errors
    /// When a pool is impossible.
    pub fn measures(&self) -> Result<Option<Measures>> {
        let wants_any = self.gaze.is_some() || self.hvsq_regions || self.hvsq_map.is_some();
        if self.display_fov.is_some() && self.gaze.is_none() && !self.hvsq_regions {
            return Err(Failure::new("`--display-fov` has no meaning for pools of one size")
                .hint("say where the eye looks with `--gaze X,Y`, or ask for `--hvsq-regions`"));
        }
        let sizes = match &self.hvsq {
            Some(sizes) => sizes.clone(),
            None if self.gaze.is_some() => Vec::new(),
            None if wants_any => default_sizes(),
            None => return Ok(None),
        };
        let display = self.display_fov.unwrap_or_default();
        let mut kinds = Vec::new();
        for size_px in sizes {
            kinds.push(Hvsq::new(Pooling::Uniform { size_px }, Distance::Mse)?);
        }
        if let Some(gaze) = self.gaze {
            let pooling = GazePooling { display, gaze, ..GazePooling::default() };
            kinds.push(Hvsq::new(Pooling::Gaze(pooling), Distance::Mse)?);
        }
        let gaze = self.gaze.unwrap_or(Gaze::CENTRE);
        Ok(Some(Measures { kinds, display, gaze, by_region: self.hvsq_regions }))
    }
}

fn default_sizes() -> Vec<f64> {
    (0..4).map(level_pooling_px).collect()
}

/// What is measured of every picture.
#[derive(Debug, Clone)]
pub struct Measures {
    kinds: Vec<Hvsq>,
    display: Display,
    gaze: Gaze,
    by_region: bool,
}

impl Default for Measures {
    /// The pools of the four quality levels.
    fn default() -> Self {
        let of_size =
            |size_px| Hvsq::new(Pooling::Uniform { size_px }, Distance::Mse).expect("levels pool over 1 and more");
        let kinds = default_sizes().into_iter().map(of_size).collect();
        Self { kinds, display: Display::default(), gaze: Gaze::CENTRE, by_region: false }
    }
}

/// HVSQ of one picture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measured {
    /// Every measure that was asked for.
    pub hvsq: Vec<Value>,
}

/// One measure.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Value {
    /// Side of the pools in pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pooling_px: Option<f64>,
    /// The point looked at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaze: Option<[f64; 2]>,
    /// HVSQ.
    pub value: f64,
    /// HVSQ of the regions by eccentricity, from the gaze outwards; null where no pixel lies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub regions: Option<Vec<Option<f64>>>,
}

impl Value {
    fn of(hvsq: &Hvsq, value: f64) -> Self {
        let (pooling_px, gaze) = match hvsq.pooling() {
            Pooling::Uniform { size_px } => (Some(*size_px), None),
            Pooling::Gaze(pooling) => (None, Some([pooling.gaze.x(), pooling.gaze.y()])),
        };
        Self { pooling_px, gaze, value, regions: None }
    }

    /// What the measure is called in tables.
    pub fn name(&self) -> String {
        self.pooling_px.map_or_else(|| "HVSQ gaze".to_owned(), |p| format!("HVSQ p={p}"))
    }
}

impl Measures {
    /// Measures one picture.
    ///
    /// # Errors
    /// When the sizes differ or a pool is larger than the picture.
    pub fn measure(&self, image: &ImageF32, target: &LossTarget) -> Result<Measured> {
        let labels = self.by_region.then(|| self.labels(target.size()));
        let image = &unmasked(image, target);
        let mut hvsq = Vec::with_capacity(self.kinds.len());
        for kind in &self.kinds {
            let reference = reference(kind, target)?;
            let mut value = Value::of(kind, reference.value(view(image))?);
            if let Some(labels) = &labels {
                value.regions = Some(reference.by_region(view(image), labels, REGION_EDGES_DEG.len() + 1)?);
            }
            hvsq.push(value);
        }
        Ok(Measured { hvsq })
    }

    /// Writes the picture of the differences of the last measure: white is the largest, the scale is that of square roots.
    ///
    /// # Errors
    /// As [`Measures::measure`]; when the file cannot be written.
    pub fn write_map(&self, path: &Path, image: &ImageF32, target: &LossTarget, console: &Console) -> Result<()> {
        let Some(kind) = self.kinds.last() else { return Ok(()) };
        let (value, map) = reference(kind, target)?.value_and_map(view(&unmasked(image, target)))?;
        let largest = map.iter().fold(0.0f32, |a, v| a.max(*v));
        let scale = if largest > 0.0 { 1.0 / largest } else { 0.0 };
        let data = map.iter().flat_map(|v| [((v * scale).sqrt() * 255.0).round() as u8; 3]).collect();
        io::save_png(path, &RgbImage8 { width: image.width, height: image.height, data })?;
        let name = Value::of(kind, value).name();
        console.note(format_args!("`{}`: {name}, white is {largest:.3e}, mean {value:.3e}", path.display()));
        Ok(())
    }

    /// The region of every pixel.
    fn labels(&self, size: (usize, usize)) -> Vec<u8> {
        let of_pixel = |i: usize| {
            let (x, y) = (PixelGrid::Centres.place(i % size.0, size.0), PixelGrid::Centres.place(i / size.0, size.1));
            let e = self.display.eccentricity_rad(size, self.gaze, x, y).to_degrees();
            REGION_EDGES_DEG.iter().filter(|edge| e >= **edge).count() as u8
        };
        (0..size.0 * size.1).map(of_pixel).collect()
    }
}

/// Means over views, as far as every view has a value.
pub fn mean(views: &[(String, Measured)]) -> Measured {
    let Some((_, first)) = views.first() else { return Measured { hvsq: Vec::new() } };
    let mean_of = |values: Vec<Option<f64>>| {
        let found: Vec<f64> = values.into_iter().flatten().collect();
        (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64)
    };
    let of_measure = |(i, value): (usize, &Value)| {
        let of_region = |k: usize| {
            let values = views.iter().map(|(_, m)| m.hvsq[i].regions.as_ref().and_then(|r| r[k]));
            mean_of(values.collect())
        };
        Value {
            value: views.iter().map(|(_, m)| m.hvsq[i].value).sum::<f64>() / views.len() as f64,
            regions: value.regions.as_ref().map(|r| (0..r.len()).map(of_region).collect()),
            ..value.clone()
        }
    };
    Measured { hvsq: first.hvsq.iter().enumerate().map(of_measure).collect() }
}

/// Measures of views as a table for people.
pub fn table(views: &[(String, Measured)], mean: &Measured) -> String {
    let width = views.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0).max("mean".len());
    let row = |name: &str, cells: Vec<String>| {
        let cells: Vec<String> = cells.into_iter().map(|cell| format!("{cell:>10}")).collect();
        format!("{name:width$}  {}", cells.join("  "))
    };
    let numbers = |m: &Measured| m.hvsq.iter().map(|v| format!("{:.3e}", v.value)).collect();
    let mut lines = vec![row("view", mean.hvsq.iter().map(Value::name).collect())];
    lines.extend(views.iter().map(|(name, m)| row(name, numbers(m))));
    lines.push(row("mean", numbers(mean)));
    lines.join("\n")
}

fn reference(kind: &Hvsq, target: &LossTarget) -> Result<HvsqReference> {
    let (width, height) = target.size();
    let data: Vec<f32> = target.rgb().iter().map(|v| from_u8(*v)).collect();
    Ok(kind.reference(ImageView { width, height, channels: 3, data: &data })?)
}

fn view(image: &ImageF32) -> ImageView<'_, f32> {
    ImageView { width: image.width as usize, height: image.height as usize, channels: 3, data: &image.data }
}

impl From<gazesplat_fovea::Error> for Failure {
    fn from(error: gazesplat_fovea::Error) -> Self {
        let hint = error.hint().unwrap_or("`gazesplat hvsq --help` says what each option takes").to_owned();
        Self::new(error.to_string()).hint(hint)
    }
}
