//! A scene as a USD stage in text: for each object its Gaussians (`ParticleField3DGaussianSplat` of OpenUSD 26.03) and a
//! convex collider.

use crate::mesh::Mesh;
use glam::{DMat3, DQuat, DVec3};
use gs_io::{Error, IoContext, Result, write_atomic};
use gs_scene::{Gaussians, sh_coefficients};
use objects::Up;
use std::fmt::Debug;
use std::io::{self, Write};
use std::path::Path;

/// An object of the stage.
pub struct Prim {
    /// Its id; none for the Gaussians of no object.
    pub id: Option<u32>,
    /// What it is called.
    pub name: Option<String>,
    /// Its Gaussians, ascending.
    pub gaussians: Vec<u32>,
    /// What others bump into; closed.
    pub collider: Option<Mesh>,
}

/// What holds for the whole stage.
pub struct StageOptions {
    /// What is up; without it the stage's axes are the geometry's.
    pub up: Option<Up>,
    /// Length of the scene's unit, where it is known.
    pub metres_per_unit: Option<f64>,
    /// Most bands of spherical harmonics.
    pub sh_degree: u8,
}

/// Refuses a name without the extension of USD in text.
pub fn check_name(path: &Path) -> Result<()> {
    match path.extension().is_some_and(|e| e == "usda") {
        true => Ok(()),
        false => Err(Error::new("not the name of a USD stage in text").file(path).expected(".usda")),
    }
}

/// Writes the stage.
///
/// # Errors
/// When the file cannot be written.
pub fn write(to: &Path, g: &Gaussians, prims: &[Prim], o: &StageOptions) -> Result<()> {
    write_atomic(to, |w| stage(w, g, prims, o).at("write", to))
}

fn stage(w: &mut dyn Write, g: &Gaussians, prims: &[Prim], o: &StageOptions) -> io::Result<()> {
    let metres = o.metres_per_unit.unwrap_or(1.0);
    let scale = if o.metres_per_unit.is_some() { "" } else { "; the length of its unit is not known: 1 m is assumed" };
    // USD knows Y and Z as up: the scene is turned so that its up is Z.
    let axis = if o.up.is_some() { "Z" } else { "Y" };
    let up = if o.up.is_some() { "" } else { "; what is up is not known: axes are those of the geometry" };
    let doc = format!("Made by export {}{scale}{up}", env!("CARGO_PKG_VERSION"));
    writeln!(w, "#usda 1.0\n(\n    defaultPrim = \"Scene\"\n    doc = {}", text(&doc))?;
    writeln!(w, "    metersPerUnit = {metres:?}\n    upAxis = \"{axis}\"\n)\n")?;
    writeln!(w, "def Xform \"Scene\" (\n    kind = \"assembly\"\n)\n{{")?;
    let mut moves = Vec::new();
    // The last of the order comes first: a scene is turned where it lies, not around a far origin.
    if g.shift != [0.0; 3] {
        writeln!(w, "    double3 xformOp:translate = {}", tuple(&g.shift))?;
        moves.push("\"xformOp:translate\"");
    }
    if let Some(up) = &o.up {
        writeln!(w, "    matrix4d xformOp:transform = {}", upright(up.vector()))?;
        moves.push("\"xformOp:transform\"");
    }
    if !moves.is_empty() {
        writeln!(w, "    uniform token[] xformOpOrder = [{}]", moves.join(", "))?;
    }
    prims.iter().filter(|p| !p.gaussians.is_empty()).try_for_each(|p| object(w, g, p, o.sh_degree))?;
    writeln!(w, "}}")
}

/// A string of USD's text.
fn text(s: &str) -> String {
    let one = |c: char| match c {
        '"' => "\\\"".to_string(),
        '\\' => "\\\\".to_string(),
        c if gs_io::is_control(c) => " ".to_string(),
        c => c.to_string(),
    };
    format!("\"{}\"", s.chars().map(one).collect::<String>())
}

/// The shortest turn that takes `up` to +z, as USD writes it: points are rows that are multiplied from the left.
fn upright(up: DVec3) -> String {
    let turn = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, up));
    // Column c of `turn` is where axis c of the stage lies in the geometry, which is just what USD's columns say.
    // Without rounding errors where it is a quarter of a turn; adding 0 makes -0 a plain 0.
    let row = |r: usize| [turn.x_axis[r], turn.y_axis[r], turn.z_axis[r], 0.0].map(|v| (v * 1e12).round() / 1e12 + 0.0);
    format!("( {}, {}, {}, (0, 0, 0, 1) )", tuple(&row(0)), tuple(&row(1)), tuple(&row(2)))
}

fn object(w: &mut dyn Write, g: &Gaussians, prim: &Prim, most: u8) -> io::Result<()> {
    let path = prim.id.map_or("no_object".into(), |id| format!("object_{id:04}"));
    writeln!(w, "\n    def Xform \"{path}\" (")?;
    if let Some(name) = &prim.name {
        writeln!(w, "        displayName = {}", text(name))?;
    }
    writeln!(w, "        kind = \"component\"\n    )\n    {{")?;
    if let Some(id) = prim.id {
        writeln!(w, "        custom int instance = {id}")?;
    }
    splats(w, g, &prim.gaussians, most)?;
    prim.collider.iter().try_for_each(|mesh| collider(w, mesh))?;
    writeln!(w, "    }}")
}

fn splats(w: &mut dyn Write, g: &Gaussians, own: &[u32], most: u8) -> io::Result<()> {
    let degree = g.sh_degree.min(most);
    let own = || own.iter().map(|&i| i as usize);
    let (low, high) = extent(g, own());
    writeln!(w, "        def ParticleField3DGaussianSplat \"gaussians\"\n        {{")?;
    list(w, "float3[] extent", [low, high].map(|p| tuple(&p)).into_iter())?;
    list(w, "point3f[] positions", own().map(|i| tuple(&g.means[i])))?;
    list(w, "quatf[] orientations", own().map(|i| tuple(&unit(g.rotations[i]))))?;
    list(w, "float3[] scales", own().map(|i| tuple(&g.log_scales[i].map(f32::exp))))?;
    list(w, "float[] opacities", own().map(|i| format!("{:?}", g.opacity(i))))?;
    writeln!(w, "            uniform int radiance:sphericalHarmonicsDegree = {degree}")?;
    let coefficients = own().flat_map(|i| g.sh_of(i).as_chunks::<3>().0[..sh_coefficients(degree)].iter());
    list(w, "float3[] radiance:sphericalHarmonicsCoefficients", coefficients.map(|c| tuple(c)))?;
    writeln!(w, "        }}")
}

fn collider(w: &mut dyn Write, mesh: &Mesh) -> io::Result<()> {
    writeln!(w, "        def Mesh \"collider\" (")?;
    writeln!(w, "            prepend apiSchemas = [\"PhysicsCollisionAPI\", \"PhysicsMeshCollisionAPI\"]")?;
    writeln!(w, "        )\n        {{")?;
    let side =
        |fold: fn(f32, f32) -> f32, start| [0, 1, 2].map(|c| mesh.vertices.iter().map(|v| v[c]).fold(start, fold));
    let (low, high) = (side(f32::min, f32::INFINITY), side(f32::max, f32::NEG_INFINITY));
    list(w, "float3[] extent", [low, high].map(|p| tuple(&p)).into_iter())?;
    list(w, "point3f[] points", mesh.vertices.iter().map(|p| tuple(p)))?;
    list(w, "int[] faceVertexCounts", mesh.triangles.iter().map(|_| "3".into()))?;
    list(w, "int[] faceVertexIndices", mesh.triangles.as_flattened().iter().map(ToString::to_string))?;
    writeln!(w, "            uniform token physics:approximation = \"convexHull\"")?;
    // Physics takes guides; renderers leave them out.
    writeln!(w, "            uniform token purpose = \"guide\"")?;
    writeln!(w, "            uniform token subdivisionScheme = \"none\"\n        }}")
}

/// An attribute that is a list, in one line.
fn list(w: &mut dyn Write, attribute: &str, mut values: impl Iterator<Item = String>) -> io::Result<()> {
    write!(w, "            {attribute} = [")?;
    values.next().iter().try_for_each(|first| write!(w, "{first}"))?;
    values.try_for_each(|value| write!(w, ", {value}"))?;
    writeln!(w, "]")
}

fn tuple<T: Debug>(values: &[T]) -> String {
    format!("({})", values.iter().map(|v| format!("{v:?}")).collect::<Vec<_>>().join(", "))
}

fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    if length > 0.0 { q.map(|v| (f64::from(v) / length) as f32) } else { [1.0, 0.0, 0.0, 0.0] }
}

/// Box around the Gaussians to three standard deviations, which is about where renderers cut them off.
fn extent(g: &Gaussians, own: impl Iterator<Item = usize>) -> ([f32; 3], [f32; 3]) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for i in own {
        let reach = 3.0 * g.log_scales[i].map(f32::exp).into_iter().fold(0.0, f32::max);
        for c in 0..3 {
            low[c] = low[c].min(g.means[i][c] - reach);
            high[c] = high[c].max(g.means[i][c] + reach);
        }
    }
    (low, high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tiny_stage_is_written_as_it_should_be() {
        let g = Gaussians {
            means: vec![[1.0, 2.0, 3.0], [0.5, 0.0, -1.0], [9.0, 9.0, 9.0]],
            log_scales: vec![[0.0; 3], [0.0, 0.5f32.ln(), 0.0], [0.0; 3]],
            rotations: vec![[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.0, 4.0], [0.0; 4]],
            opacity_logits: vec![0.0, 50.0, 0.0],
            sh: (0..3 * 12).map(|i| i as f32).collect(),
            sh_degree: 1,
            ..Gaussians::default()
        };
        let collider = Mesh {
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        };
        let prims = [
            Prim {
                id: Some(7),
                name: Some("a \"red\"\\\nmug".into()),
                gaussians: vec![0, 1],
                collider: Some(collider),
            },
            Prim { id: Some(8), name: None, gaussians: vec![], collider: None },
            Prim { id: None, name: None, gaussians: vec![2], collider: None },
        ];
        let o = StageOptions { up: "-y".parse().ok(), metres_per_unit: Some(0.5), sh_degree: 0 };
        let mut bytes = Vec::new();
        stage(&mut bytes, &g, &prims, &o).unwrap();
        let golden = include_str!("../testdata/tiny.usda").replace("VERSION", env!("CARGO_PKG_VERSION"));
        assert_eq!(String::from_utf8(bytes).unwrap(), golden);
        // A scene far from the origin is moved there in double precision, after it is turned.
        let far = Gaussians { shift: [448_262.0, 5_411_932.0, 114.5], ..g.clone() };
        let mut bytes = Vec::new();
        stage(&mut bytes, &far, &prims, &o).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        assert!(text.contains("    double3 xformOp:translate = (448262.0, 5411932.0, 114.5)\n"), "{text}");
        assert!(text.contains("xformOpOrder = [\"xformOp:translate\", \"xformOp:transform\"]\n"), "{text}");
        // With all bands there are four coefficients a Gaussian, grouped by Gaussian.
        let mut bytes = Vec::new();
        stage(&mut bytes, &g, &prims[..1], &StageOptions { up: None, metres_per_unit: None, sh_degree: 3 }).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        assert!(text.contains("sphericalHarmonicsDegree = 1\n"));
        assert!(
            text.contains(
                "Coefficients = [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0), (6.0, 7.0, 8.0), (9.0, 10.0, 11.0), (12.0,"
            )
        );
        assert!(
            text.contains("upAxis = \"Y\"") && text.contains("what is up is not known") && !text.contains("xformOp")
        );
    }

    #[test]
    fn the_stage_stands_upright() {
        for up in [DVec3::NEG_Y, DVec3::new(0.3, -0.4, 0.5).normalize(), DVec3::Z, DVec3::NEG_Z] {
            let words = upright(up);
            let numbers: Vec<f64> = words
                .split(|c: char| "(), ".contains(c))
                .filter(|w| !w.is_empty())
                .map(|w| w.parse().unwrap())
                .collect();
            // Row vector times matrix.
            let moved = DVec3::from_array([0, 1, 2].map(|c| (0..3).map(|r| up[r] * numbers[4 * r + c]).sum()));
            assert!(moved.distance(DVec3::Z) < 1e-12, "{words}");
        }
    }
}
