//! The plan of the trade-offs: a text file of lines, a keyword and fields with `|` between; `#` begins a comment line.
//!
//! | line | meaning |
//! |---|---|
//! | `scene NAME \| synth-scene \| geometry` | a scene: options of synth-scene, and of gs-geom train |
//! | `repeats \| COUNT` | how often each point is timed, in turns |
//! | `knob NAME \| STAGE \| title` | an approximation of a stage: `geometry`, `graph`, `features`, `instances` or `pipeline` |
//! | `point KNOB \| LABEL \| options \| role` | a setting; role: `exact`, `default`, both or none. Options of other stages than the knob's: `stage: options; stage: options` |
//! | `axis NAME \| title \| STAGE ...` | a size that stages are timed against |
//! | `size AXIS \| VALUE \| scene \| geometry` | one size: options of synth-scene and gs-geom train |

use crate::chain::{Options, Stage};
use gs_io::{Error, IoContext, Result};
use std::path::Path;

/// A scene to measure on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scene {
    /// Its name.
    pub name: String,
    /// Options of synth-scene.
    pub scene: String,
    /// Options of gs-geom train.
    pub geometry: String,
}

/// A setting of a knob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Point {
    /// What it is called.
    pub label: String,
    /// Options of the stages it changes.
    pub options: Options,
    /// Whether the others' errors are differences from it.
    pub exact: bool,
    /// Whether it is what the stage does by itself.
    pub default: bool,
}

/// An approximation, with the settings to compare.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Knob {
    /// Its name.
    pub name: String,
    /// The first stage that it changes; `None` for the whole pipeline.
    pub stage: Option<Stage>,
    /// What it is.
    pub title: String,
    /// Its settings, one of them exact.
    pub points: Vec<Point>,
}

/// A size of the work.
#[derive(Debug, Clone, PartialEq)]
pub struct Size {
    /// How large.
    pub value: f64,
    /// The scene of that size.
    pub scene: Scene,
}

/// Something that the work grows with.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// Its name.
    pub name: String,
    /// What it counts.
    pub title: String,
    /// The stages whose growth is fitted.
    pub stages: Vec<Stage>,
    /// By rising value.
    pub sizes: Vec<Size>,
}

/// What to measure.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Scenes of the knobs.
    pub scenes: Vec<Scene>,
    /// How often each point is timed.
    pub repeats: usize,
    /// Approximations.
    pub knobs: Vec<Knob>,
    /// Growth.
    pub axes: Vec<Axis>,
}

impl Plan {
    /// Reads a plan.
    ///
    /// # Errors
    /// When it cannot be read, a line is not understood, names what was not introduced, or a knob lacks its one exact or its
    /// one default point; the error names the line.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).at("read", path)?;
        Self::parse(&text).map_err(|e| e.file(path))
    }

    /// Reads the text of a plan; errors as [`Self::read`].
    ///
    /// # Errors
    /// See there.
    pub fn parse(text: &str) -> Result<Self> {
        let mut plan = Self { scenes: Vec::new(), repeats: 3, knobs: Vec::new(), axes: Vec::new() };
        for (number, line) in text.lines().enumerate() {
            if !line.trim().is_empty() && !line.starts_with('#') {
                plan.line(line).map_err(|e| e.field(format!("line {}", number + 1)))?;
            }
        }
        for k in &plan.knobs {
            let count = |f: fn(&Point) -> bool| k.points.iter().filter(|p| f(p)).count();
            if count(|p| p.exact) != 1 || count(|p| p.default) != 1 {
                return Err(Error::new("a knob without its one exact and its one default point").field(&k.name));
            }
        }
        Ok(plan)
    }

    fn line(&mut self, line: &str) -> Result<()> {
        let fields: Vec<&str> = line.split('|').map(str::trim).collect();
        let (keyword, name) = fields[0].split_once(' ').unwrap_or((fields[0], ""));
        let name = name.trim();
        let field =
            |i: usize| fields.get(i).copied().ok_or_else(|| Error::new("a line with too few fields").found(line));
        let unknown = |what: &str| Error::new(format!("no such {what}")).found(name).found(line);
        let scene = |name: &str, at: usize| -> Result<Scene> {
            Ok(Scene { name: name.into(), scene: field(at)?.into(), geometry: field(at + 1)?.into() })
        };
        match keyword {
            "scene" => self.scenes.push(scene(name, 1)?),
            "repeats" => self.repeats = number(field(1)?)? as usize,
            "knob" => {
                let stage = (field(1)? != "pipeline").then(|| field(1)?.parse()).transpose()?;
                let (name, title) = (name.into(), field(2)?.into());
                self.knobs.push(Knob { name, stage, title, points: Vec::new() });
            }
            "point" => {
                let knob = self.knobs.iter_mut().find(|k| k.name == name).ok_or_else(|| unknown("knob"))?;
                let roles: Vec<&str> = fields.get(3).map(|r| r.split(' ').collect()).unwrap_or_default();
                let options = match knob.stage {
                    Some(stage) if !field(2)?.contains(':') => Options::of(stage, field(2)?),
                    _ => Options::parse(field(2)?)?,
                };
                let (exact, default) = (roles.contains(&"exact"), roles.contains(&"default"));
                knob.points.push(Point { label: field(1)?.into(), options, exact, default });
            }
            "axis" => {
                let stages = field(2)?.split(' ').map(str::parse).collect::<Result<_>>()?;
                self.axes.push(Axis { name: name.into(), title: field(1)?.into(), stages, sizes: Vec::new() });
            }
            "size" => {
                let value = number(field(1)?)?;
                let scene = scene(&format!("{name}-{}", field(1)?), 2)?;
                let axis = self.axes.iter_mut().find(|a| a.name == name).ok_or_else(|| unknown("axis"))?;
                axis.sizes.push(Size { value, scene });
            }
            _ => return Err(Error::new("no such keyword").found(keyword)),
        }
        Ok(())
    }
}

fn number(text: &str) -> Result<f64> {
    let value = text.parse::<f64>().ok().filter(|v| *v > 0.0 && v.is_finite());
    value.ok_or_else(|| Error::new("not a number").found(text).expected("a number above 0"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# a comment
scene a | --size tiny | --iterations 10
repeats | 5
knob cut | graph | Footprint cut
point cut | none | | exact
point cut | small | --cut 0.01 | default
knob quality | pipeline | Quality
point quality | exact | geometry: --iterations 20; graph: --cut 0 | exact default
axis views | Photographs | graph features
size views | 8 | --size tiny --views 8 | --iterations 10
";

    #[test]
    fn a_plan_is_read() {
        let p = Plan::parse(TEXT).unwrap();
        assert_eq!((p.scenes.len(), p.repeats, p.knobs.len()), (1, 5, 2));
        let cut = &p.knobs[0];
        assert_eq!(cut.stage, Some(Stage::Graph));
        assert!(cut.points[0].exact && !cut.points[0].default && cut.points[1].default);
        assert_eq!(cut.points[1].options.get(Stage::Graph), ["--cut", "0.01"]);
        assert_eq!(p.knobs[1].points[0].options.get(Stage::Geometry), ["--iterations", "20"]);
        assert_eq!((p.axes[0].stages.len(), p.axes[0].sizes[0].value), (2, 8.0));
        assert_eq!(p.axes[0].sizes[0].scene.name, "views-8");
    }

    #[test]
    fn mistakes_name_their_line() {
        for (from, to, said) in [
            ("repeats | 5", "repeats | x", "line 3"),
            ("knob cut | graph", "knob cut | grph", "line 4"),
            ("point cut | none", "point cot | none", "cot"),
            ("| exact\npoint cut", "|\npoint cut", "exact"),
            ("axis views", "axes views", "keyword"),
            ("graph: --cut 0", "grph: --cut 0", "grph"),
        ] {
            let e = Plan::parse(&TEXT.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(e.contains(said), "{e}");
        }
    }
}
