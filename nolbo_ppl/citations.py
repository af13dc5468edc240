"""The works behind the library, as BibTeX."""

from __future__ import annotations

from nolbo_ppl.errors import input_error

REFERENCES: dict[str, str] = {
    "nolbo": """@inproceedings{yu2019nolbo,
  title = {Not Only Look But Observe: Variational Observation Model of Scene-Level 3D Multi-Object Understanding for
           Probabilistic SLAM},
  author = {Yu, Hyeonwoo},
  year = {2019},
  note = {arXiv:1907.09760}
}""",
    "pyro": """@article{bingham2019pyro,
  title = {Pyro: Deep Universal Probabilistic Programming},
  author = {Bingham, Eli and Chen, Jonathan P. and Jankowiak, Martin and Obermeyer, Fritz and Pradhan, Neeraj and
            Karaletsos, Theofanis and Singh, Rohit and Szerlip, Paul and Horsfall, Paul and Goodman, Noah D.},
  journal = {Journal of Machine Learning Research},
  volume = {20},
  pages = {28:1--28:6},
  year = {2019}
}""",
    "darknet19": """@inproceedings{redmon2017yolo9000,
  title = {YOLO9000: Better, Faster, Stronger},
  author = {Redmon, Joseph and Farhadi, Ali},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition},
  year = {2017}
}""",
    "3dgan": """@inproceedings{wu2016learning,
  title = {Learning a Probabilistic Latent Space of Object Shapes via 3D Generative-Adversarial Modeling},
  author = {Wu, Jiajun and Zhang, Chengkai and Xue, Tianfan and Freeman, William T. and Tenenbaum, Joshua B.},
  booktitle = {Advances in Neural Information Processing Systems},
  year = {2016}
}""",
    "pascal3d": """@inproceedings{xiang2014beyond,
  title = {Beyond PASCAL: A Benchmark for 3D Object Detection in the Wild},
  author = {Xiang, Yu and Mottaghi, Roozbeh and Savarese, Silvio},
  booktitle = {IEEE Winter Conference on Applications of Computer Vision},
  year = {2014}
}""",
    "muon": """@misc{jordan2024muon,
  title = {Muon: An optimizer for hidden layers in neural networks},
  author = {Jordan, Keller and others},
  year = {2024},
  howpublished = {https://kellerjordan.github.io/posts/muon/}
}""",
    "gtsam": """@misc{dellaert2012gtsam,
  title = {Factor Graphs and GTSAM: A Hands-on Introduction},
  author = {Dellaert, Frank},
  howpublished = {Technical report GT-RIM-CP\\&R-2012-002, Georgia Institute of Technology},
  year = {2012}
}""",
    "bowman": """@inproceedings{bowman2017probabilistic,
  title = {Probabilistic Data Association for Semantic SLAM},
  author = {Bowman, Sean L. and Atanasov, Nikolay and Daniilidis, Kostas and Pappas, George J.},
  booktitle = {IEEE International Conference on Robotics and Automation},
  year = {2017}
}""",
}
"""BibTeX entries by name."""


def citation(*names: str) -> str:
    """BibTeX of the works behind the library; of all of them without arguments.

    Raises:
        InputError: an unknown name.

    Example:
        >>> import nolbo_ppl
        >>> print(nolbo_ppl.citation("pyro").splitlines()[0])
        @article{bingham2019pyro,
    """
    unknown = sorted(set(names) - set(REFERENCES))
    if unknown:
        raise input_error("unknown reference", got=unknown, expected=f"names among {sorted(REFERENCES)}")
    return "\n\n".join(REFERENCES[name] for name in (names or REFERENCES))
