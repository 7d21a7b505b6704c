//! A finished geometry, as every stage after the first reads it.

use crate::{Gaussians, Learnt, ply, splat};
use gs_io::{Error, Result};
use std::path::Path;

/// Opacity logit of a Gaussian that nothing shows.
const INVISIBLE: f32 = -50.0;

/// The Gaussians of a file and how to treat them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Geometry {
    /// All Gaussians of the file, in its order, every number finite; [`Self::damaged`] ones are invisible stand-ins.
    pub gaussians: Gaussians,
    /// Gaussians with a parameter that is not finite in the file, ascending. No view sees them, and no instance has them.
    pub damaged: Vec<u32>,
    /// Whether they were learnt with the 2D filter of Mip-Splatting, and so are to be rendered with it.
    pub antialias: bool,
    /// What the file has that was left out, such as spherical harmonics of degree 4.
    pub left_out: Vec<String>,
    /// Which views they were learnt from, where the file says it.
    pub learnt: Option<Learnt>,
}

impl Geometry {
    /// Reads a file of any of the formats of [`splat`] that is one file. Damaged Gaussians do not condemn the rest: a transparent one takes the place of each, where its centre
    /// is or, if that cannot be used, where the first whole Gaussian is, so that numbers stay and boxes do not grow. Infinite
    /// opacity logits are no damage: they become +-50, as in [`splat::read_whole`].
    ///
    /// # Errors
    /// When the file is damaged as a whole, is of no known format, or is several, or all of its Gaussians are damaged.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        if let [_, .., last] = &splat::files(path)?[..] {
            return Err(Error::new(
                "the Gaussians lie in several files, and artifacts name a geometry by the hash of one",
            )
            .file(path)
            .found(last.display())
            .hint("make one file of them: gs-geom convert IN OUT.ply"));
        }
        let splat::Splat { gaussians: mut g, antialias, left_out, .. } = splat::read(path)?;
        let learnt = Learnt::read(path)?;
        g.bound_opacities();
        let stride = g.sh_stride();
        let damaged: Vec<u32> = (0..g.len() as u32).filter(|&i| !g.is_whole(i as usize)).collect();
        let Some(first) = (0..g.len()).find(|&i| damaged.get(i) != Some(&(i as u32))) else {
            if g.is_empty() {
                return Ok(Self { gaussians: g, damaged, antialias, left_out, learnt });
            }
            return Err(Error::new(
                "no Gaussian is whole: every one has a number that is not finite, or a rotation of length 0",
            )
            .file(path)
            .found(g.len())
            .hint("train the geometry again"));
        };
        let place = g.means[first];
        for i in damaged.iter().map(|&i| i as usize) {
            if !g.is_near(i) {
                g.means[i] = place;
            }
            g.log_scales[i] = [-10.0; 3];
            g.rotations[i] = [1.0, 0.0, 0.0, 0.0];
            g.opacity_logits[i] = INVISIBLE;
            g.sh[i * stride..(i + 1) * stride].fill(0.0);
        }
        Ok(Self { gaussians: g, damaged, antialias, left_out, learnt })
    }

    /// What is to be said of damaged Gaussians and of what was left out, where there are any.
    pub fn damage(&self) -> Option<String> {
        let damaged = self.damaged.first().map(|first| {
            let (damaged, all) = (self.damaged.len(), self.gaussians.len());
            format!("{damaged} of {all} Gaussians: damaged, a parameter is not finite, a centre beyond 1e17 or a rotation of length 0 (the first is vertex {first})")
        });
        let left_out = self.left_out.iter().map(|what| format!("not read: {what}"));
        let said: Vec<String> = damaged.into_iter().chain(left_out).collect();
        Some(said.join("; ")).filter(|said| !said.is_empty())
    }

    /// Whether each Gaussian is whole.
    pub fn whole(&self) -> Vec<bool> {
        let mut whole = vec![true; self.gaussians.len()];
        self.damaged.iter().for_each(|&i| whole[i as usize] = false);
        whole
    }

    /// Comments for a PLY of these Gaussians: `own`, and the mark of how they are to be rendered.
    pub fn comments(&self, mut own: Vec<String>) -> Vec<String> {
        own.extend(self.antialias.then(|| ply::ANTIALIASED.to_string()));
        own.extend(self.learnt.iter().flat_map(Learnt::comments));
        own
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Gaussians {
        Gaussians {
            means: (0..7).map(|i| [i as f32, 1.0, 2.0]).collect(),
            log_scales: vec![[-1.0; 3]; 7],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 7],
            opacity_logits: vec![2.0; 7],
            sh: vec![0.25; 7 * 12],
            sh_degree: 1,
            ..Gaussians::default()
        }
    }

    #[test]
    fn damaged_gaussians_become_invisible_and_the_rest_stays() {
        [f32::NAN, 1e19].into_iter().for_each(damaged);
    }

    /// One of them has `first` for a coordinate.
    fn damaged(first: f32) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("g.ply");
        let mut g = sample();
        g.means[0][1] = first;
        g.log_scales[2][0] = f32::INFINITY;
        g.rotations[3] = [0.0; 4];
        g.opacity_logits[4] = f32::NAN;
        g.opacity_logits[5] = f32::INFINITY;
        g.sh[6 * 12 + 11] = f32::NEG_INFINITY;
        ply::write_gaussians(&path, &g, &[]).unwrap();
        let read = Geometry::read(&path).unwrap();
        assert_eq!(read.damaged, [0, 2, 3, 4, 6]);
        assert_eq!(read.gaussians.select(&[1]), sample().select(&[1]));
        assert_eq!(read.gaussians.opacity_logits[5], 50.0);
        assert_eq!(read.gaussians.means[0], [1.0, 1.0, 2.0], "where the first whole one is");
        assert_eq!(read.gaussians.means[2], [2.0, 1.0, 2.0], "where it was");
        assert!(read.damaged.iter().all(|&i| read.gaussians.opacity(i as usize) < 1e-20));
        let said = read.damage().unwrap();
        assert!(said.contains("5 of 7 Gaussians") && said.contains("vertex 0"), "{said}");
        assert_eq!(read.whole(), [false, true, false, false, false, true, false]);
        // Written and read again it is no longer damaged.
        ply::write_gaussians(&path, &read.gaussians, &read.comments(Vec::new())).unwrap();
        assert_eq!((Geometry::read(&path).unwrap().damage(), read.antialias), (None, false));
        g.means.fill([f32::NAN; 3]);
        ply::write_gaussians(&path, &g, &[]).unwrap();
        assert!(Geometry::read(&path).unwrap_err().to_string().contains("no Gaussian is whole"));
    }

    #[test]
    fn the_mark_of_the_filter_is_read_and_passed_on() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("g.ply");
        ply::write_gaussians(&path, &sample(), &["antialias true".into()]).unwrap();
        let read = Geometry::read(&path).unwrap();
        assert!(read.antialias && read.damage().is_none());
        assert_eq!(read.comments(vec!["mine".into()]), ["mine", "antialias true"]);
    }
}
