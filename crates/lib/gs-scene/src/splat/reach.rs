//! Gaussians that lie so far out that a format of few bits would have none left for the others, and other losses to speak of.

use super::Format;
use super::packing::along_a_curve;
use crate::{Gaussians, say_shift};
use std::path::Path;

/// Reach in spreads ([`Gaussians::spread`]): 24 bits of it are steps of a thousandth of the spread.
const REACH: f64 = 8192.0;
/// Those beyond it are floaters where they are at most one in so many.
const FEW: usize = 100;

fn is_near(g: &Gaussians, i: usize, reach: f64) -> bool {
    g.means[i].iter().all(|v| f64::from(v.abs()) <= reach)
}

/// The Gaussians that a file has, in its order; none where it has all of them in theirs.
pub(super) fn order(format: Format, g: &Gaussians) -> Option<Vec<u32>> {
    let near = near(format, g);
    match format {
        Format::CompressedPly | Format::Sog => {
            Some(along_a_curve(g, &near.unwrap_or_else(|| (0..g.len() as u32).collect())))
        }
        _ => near,
    }
}

/// The Gaussians without floaters, where there are some and the format cannot hold them beside the others.
fn near(format: Format, g: &Gaussians) -> Option<Vec<u32>> {
    if ![Format::Spz, Format::CompressedPly, Format::Sog].contains(&format) {
        return None;
    }
    let reach = REACH * g.spread();
    let kept: Vec<u32> = (0..g.len() as u32).filter(|&i| is_near(g, i as usize, reach)).collect();
    let floaters = g.len() - kept.len();
    (floaters > 0 && FEW * floaters <= g.len()).then_some(kept)
}

/// What a file of this name loses of the Gaussians that is worth a warning: a shift, floaters, digits of all centres.
///
/// # Errors
/// When the name says no format that is written.
pub fn lost(path: &Path, g: &Gaussians) -> gs_io::Result<Vec<String>> {
    let format = Format::to_write(path)?;
    let mut lost = Vec::new();
    if g.shift != [0.0; 3] && [Format::Spz, Format::Sog, Format::Splat].contains(&format) {
        lost.push(format!(
            "the shift {} has no place in this format: add it to the centres to get the world's coordinates, or write .ply or .glb, which keep it",
            say_shift(g.shift)
        ));
    }
    let near = near(format, g);
    if let Some(near) = &near {
        lost.push(format!(
            "{} of {} Gaussians are left out: they lie more than {REACH} times the scene's size of {:.3} units from the origin, and would cost \
             the others their digits",
            g.len() - near.len(),
            g.len(),
            g.spread()
        ));
    }
    let kept = near.unwrap_or_else(|| (0..g.len() as u32).collect());
    let farthest = kept.iter().flat_map(|&i| g.means[i as usize]).fold(0.0f32, |most, v| most.max(v.abs()));
    let coarse = match format {
        Format::Spz => f64::from(farthest) > REACH * g.spread(),
        // 16 bits of sign(x) ln(1 + |x|): steps of more than a thousandth of the spread where the scene is.
        Format::Sog => 2.0 * f64::from(farthest).ln_1p() / 65535.0 * (1.0 + g.spread()) > 1e-3 * g.spread(),
        _ => false,
    };
    if coarse {
        lost.push(format!(
            "centres have few digits: the farthest reaches to {farthest} units, the scene's size is {:.3}; crop it first: gs-geom convert --crop",
            g.spread()
        ));
    }
    Ok(lost)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::{Extra, encode, read, testing::cloud};

    #[test]
    fn a_floater_costs_the_others_no_digits() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.spz", "a.compressed.ply", "a.sog"] {
            let path = dir.path().join(name);
            let mut g = cloud(300, 1);
            let format = Format::to_write(&path).unwrap();
            let plain = encode(format, &g.select(&(0..299).collect::<Vec<u32>>()), &Extra::default()).unwrap();
            g.means[299] = [0.0, 1e6, 0.0];
            assert_eq!(encode(format, &g, &Extra::default()).unwrap(), plain, "{name}: as without it");
            let said = lost(&path, &g).unwrap();
            assert!(said.len() == 1 && said[0].starts_with("1 of 300 Gaussians are left out"), "{said:?}");
            std::fs::write(&path, plain).unwrap();
            assert_eq!(read(&path).unwrap().gaussians.len(), 299);
            // Where they are many they are no floaters.
            (0..9).for_each(|i| g.means[i] = [0.0, 1e6, 0.0]);
            let few_digits = lost(&path, &g).unwrap();
            assert_eq!(few_digits.len(), usize::from(format == Format::Spz), "{few_digits:?}");
            assert!(few_digits.iter().all(|said| said.starts_with("centres have few digits")), "{few_digits:?}");
        }
        // Steps of a SOG do not shrink with a small scene.
        let mut g = cloud(300, 0);
        g.means.iter_mut().for_each(|m| *m = m.map(|v| v / 1024.0));
        g.means[299][0] = 16.0;
        assert_eq!(lost(Path::new("a.sog"), &g).unwrap().len(), 1);
    }

    #[test]
    fn a_shift_is_kept_or_said() {
        let dir = tempfile::tempdir().unwrap();
        let shift = [448_262.0, 5_411_932.0, -114.0];
        let g = Gaussians { shift, ..cloud(40, 1) };
        for (name, keeps) in [
            ("a.ply", true),
            ("a.compressed.ply", true),
            ("a.glb", true),
            ("a.spz", false),
            ("a.sog", false),
            ("a.splat", false),
        ] {
            let path = dir.path().join(name);
            crate::splat::write(&path, &g, &Extra::default()).unwrap();
            let read = read(&path).unwrap();
            assert_eq!(read.gaussians.shift, if keeps { shift } else { [0.0; 3] }, "{name}");
            assert!(read.left_out.is_empty(), "{name}: {:?}", read.left_out);
            let said = lost(&path, &g).unwrap();
            assert!(said.is_empty() == keeps && said.iter().all(|s| s.contains("448262 5411932 -114")), "{said:?}");
        }
    }
}
